"""The proof: the models before and after, on poses that no fit has seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.calibrate import Errors

RESAMPLES = 2000
BLOCKS = 20


@dataclass(frozen=True)
class Proof:
    """Held-out errors of every model, and what adding the effects changed.

    Attributes:
        errors: by model name, (N, 3) measured - predicted, m.
        rows: by model name, their figures.
        gain_ci95: of the mean 3-D error, calibrated minus with effects, m; None without both.
        better: whether the effects lowered the held-out squared error beyond chance (95 %,
            one-sided); a model may not grow on a gain that the hold-out does not support.
    """

    errors: Mapping[str, np.ndarray]
    rows: Mapping[str, Errors]
    gain_ci95: tuple[float, float] | None
    better: bool


def prove(errors: Mapping[str, np.ndarray], rng: np.random.Generator) -> Proof:
    """Figures and a paired block bootstrap of the difference.

    Args:
        errors: by model name, in the order of the ladder, (N, 3) in m, rows in time order.
        rng: for the bootstrap.
    """
    rows = {name: Errors.of(e) for name, e in errors.items()}
    if "with_effects" not in errors or "calibrated" not in errors:
        return Proof(errors, rows, None, False)
    before = np.linalg.norm(errors["calibrated"], axis=1)
    after = np.linalg.norm(errors["with_effects"], axis=1)
    means = _resampled(before - after, rng)
    low, high = np.percentile(means, [2.5, 97.5])
    squared = _resampled(before**2 - after**2, rng)
    better = bool(np.percentile(squared, 5.0) > 0)
    return Proof(errors, rows, (float(low), float(high)), better)


def _resampled(gain: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Means over blocks drawn with replacement, (RESAMPLES,)."""
    blocks = np.array_split(gain, min(BLOCKS, len(gain)))
    sums = np.array([b.sum() for b in blocks])
    sizes = np.array([len(b) for b in blocks])
    drawn = rng.integers(len(blocks), size=(RESAMPLES, len(blocks)))
    return sums[drawn].sum(1) / sizes[drawn].sum(1)
