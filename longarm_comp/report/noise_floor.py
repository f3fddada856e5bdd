"""The noise that the held-out errors leave room for.

Noise that is estimated from the residual holds whatever no model explained.  Where a model errs
by less than that, or structure is left, the estimate is an upper bound, and what is shown and
subtracted is limited to what the errors leave room for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv


@dataclass(frozen=True)
class ErrorFigures:
    """Errors of 3-D lengths and of axes, in one unit and its square."""

    mean: float
    rms: float
    p95: float
    max: float
    mean_abs_z: float
    variance: float


@dataclass(frozen=True)
class NoiseFloor:
    """What noise alone would show.

    Attributes:
        sigma: (3,) standard deviation per axis; the estimate, or less.
        limited: whether it is less, as the errors leave room for so much at most.
        figures: of n rows of it, with the mean sigma for all axes; max is the median of the
            largest, or the smallest largest error of a model.
    """

    sigma: tuple[float, float, float]
    limited: bool
    figures: ErrorFigures


def noise_floor(
    sigma: Sequence[float],
    n: int,
    rows: Iterable[ErrorFigures],
    structure: tuple[float, float] | None = None,
) -> NoiseFloor | None:
    """The floor; None where the errors leave no room for noise of that kind.

    Args:
        sigma: (3,) estimated noise per axis.
        n: number of held-out rows.
        rows: figures of every model on them.
        structure: RMS of the model in use and of the structure that it leaves, where it does.
    """
    whole, models = _gaussian(sigma, n), list(rows)
    if not whole.rms:
        return None
    ratios = [
        found / full
        for row in models
        for found, full in (
            (row.mean, whole.mean),
            (row.rms, whole.rms),
            (row.p95, whole.p95),
            (row.mean_abs_z, whole.mean_abs_z or np.inf),
            (sqrt(row.variance), sqrt(whole.variance)),
        )
        if np.isfinite(full)
    ]
    if structure is not None:
        ratios.append(sqrt(max(0.0, structure[0] ** 2 - structure[1] ** 2)) / whole.rms)
    share = min(1.0, *ratios) if ratios else 1.0
    # Where less of the estimate than this share has room, the noise is not known
    if share < 0.05:
        return None
    kept = tuple(share * s for s in sigma)
    figures = _gaussian(kept, n, min((row.max for row in models), default=np.inf))
    return NoiseFloor((kept[0], kept[1], kept[2]), share < 1.0, figures)


def excess(rms: float, floor: NoiseFloor | None) -> float:
    """RMS beyond the noise."""
    return sqrt(max(0.0, rms**2 - (0.0 if floor is None else floor.figures.rms**2)))


def normal_length(share: ArrayLike) -> np.ndarray:
    """Length that a share of vectors of three unit normal components stays below."""
    return np.asarray(np.sqrt(2.0 * gammaincinv(1.5, share)))


def _gaussian(sigma: Sequence[float], n: int, longest: float = np.inf) -> ErrorFigures:
    variance = float(np.mean(np.square(sigma)))
    scale = sqrt(variance) or 1.0
    largest = scale * float(normal_length(0.5 ** (1 / max(n, 1))))
    return ErrorFigures(
        scale * sqrt(8 / np.pi),
        sqrt(3 * variance),
        scale * float(normal_length(0.95)),
        min(largest, longest),
        sigma[2] * sqrt(2 / np.pi),
        variance,
    )
