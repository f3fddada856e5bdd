"""The noise that the held-out errors leave room for.

Noise estimated from the residual is an upper bound, because the residual may hold structure too, or
another model may err by less.  So no more noise is shown and subtracted than these errors allow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from longarm_comp.report.record import DiagnosisReport

FIGURES = ("mean_mm", "rms_mm", "p95_mm", "max_mm", "mean_abs_z_mm", "variance_mm2")
"""Names of the errors in a row of report.json: of 3-D lengths and of axes, mm and mm^2."""


@dataclass(frozen=True)
class _NoiseFloor:
    """Errors that noise alone would show."""

    sigma_mm: tuple[float, float, float]  # standard deviation per axis
    limited: bool  # whether it is less than the estimate
    figures: Mapping[str, float]
    """Errors by the names in `FIGURES`, with the mean sigma for all axes.

    ``max_mm`` is the median of the largest, but at most the smallest ``max_mm`` of any model.
    """


def floor_of(report: DiagnosisReport) -> _NoiseFloor | None:
    """Return a report's floor; None where no noise is known, or the errors leave no room for it."""
    held, left, sigma_mm = report.held_out, report.structure_left, report.noise.sigma_mm
    if sigma_mm is None or not held.n:
        return None
    whole = _noise_of(sigma_mm, held.n)
    if not whole["rms_mm"]:
        return None
    ratios = []
    for row in held.rows:
        for name, full in whole.items():
            if name != "max_mm" and full:
                ratio = getattr(row, name) / full
                ratios.append(sqrt(ratio) if name == "variance_mm2" else ratio)
    # Structure that the model in use leaves is no noise
    written = "calibrated" if report.written is None else report.written.model
    structure = left.size_mm or 0.0 if left.flag else 0.0
    rms = next((row.rms_mm for row in held.rows if row.model == written), None)
    if structure and rms is not None:
        ratios.append(sqrt(max(0.0, rms**2 - structure**2)) / whole["rms_mm"])
    share = min(1.0, *ratios) if ratios else 1.0
    # Where less of the estimate than this share has room, the noise is not known
    if share < 0.05:
        return None
    x, y, z = (share * s for s in sigma_mm)
    figures = _noise_of((x, y, z), held.n, min((row.max_mm for row in held.rows), default=np.inf))
    return _NoiseFloor((x, y, z), share < 1.0, figures)


def excess(rms_mm: float, floor: _NoiseFloor | None) -> float:
    """Return the part of an RMS error that is beyond the noise floor, mm."""
    return sqrt(max(0.0, rms_mm**2 - (0.0 if floor is None else floor.figures["rms_mm"] ** 2)))


def normal_length(share: ArrayLike) -> np.ndarray:
    """Return the length that a share of vectors (3,) of unit normal components does not exceed."""
    return np.asarray(np.sqrt(2.0 * gammaincinv(1.5, share)))


def _noise_of(sigma_mm: Sequence[float], n: int, longest: float = np.inf) -> dict[str, float]:
    variance = float(np.mean(np.square(sigma_mm)))
    scale = sqrt(variance) or 1.0
    largest = scale * float(normal_length(0.5 ** (1 / max(n, 1))))
    lengths = (scale * sqrt(8 / np.pi), sqrt(3 * variance), scale * float(normal_length(0.95)))
    along_z = sigma_mm[2] * sqrt(2 / np.pi)
    return dict(zip(FIGURES, (*lengths, min(largest, longest), along_z, variance), strict=True))
