"""The proof: the models before and after, on poses that no fit has seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi, norm

from longarm_comp.core.identify.calibrate import Errors

OFF = 1.5
"""Held-out errors of more than this many times the noise are not noise."""
DECIDES = (4 * norm.ppf(0.95)) ** 2
"""Gain in squared error, in units of the noise, from which on a real effect of the fitted size
would pass a 95 % test 95 times in 100: the gain scatters by twice its root."""
RESAMPLES = 2000
BLOCKS = 20


@dataclass(frozen=True)
class Proof:
    """Held-out errors of every model, and what adding the effects changed.

    Attributes:
        errors: by model name, (N, 3) measured - predicted, m.
        rows: by model name, their figures.
        gain_ci95: of the mean 3-D error, calibrated minus with effects, m; None without both.
        better: whether the effects lowered the held-out squared error, each axis in units of its
            noise, beyond chance (95 %, one-sided), or at all where the hold-out is too small to
            show effects of their size; a model may not grow on a gain that the hold-out does not
            support.
        misfit: median held-out error of the final model over what noise and the fit's own
            uncertainty would give.
        excess_m: its RMS beyond the noise, outliers clipped, m.
        share: of the squared held-out error beyond the noise, what the effects took.
    """

    errors: Mapping[str, np.ndarray]
    rows: Mapping[str, Errors]
    gain_ci95: tuple[float, float] | None
    better: bool
    misfit: float = 1.0
    excess_m: float = 0.0
    share: float = 1.0

    @property
    def off(self) -> bool:
        """Whether held-out poses err by much more than the noise, whatever the fit says."""
        return self.misfit > OFF

    def plus(self, name: str, error: np.ndarray) -> Proof:
        """With the errors (N, 3), m, of one more model."""
        rows = {**self.rows, name: Errors.of(error)}
        return dataclasses.replace(self, errors={**self.errors, name: error}, rows=rows)


def prove(
    errors: Mapping[str, np.ndarray], spread: Mapping[str, np.ndarray], rng: np.random.Generator
) -> Proof:
    """Figures, a paired block bootstrap of the difference, and the hold-out against the noise.

    Args:
        errors: by model name, in the order of the ladder, (N, 3) in m, rows in time order.
        spread: for `calibrated` and `with_effects`, (N, 3) what the errors should scatter by:
            noise and the uncertainty of the fitted parameters, m.
        rng: for the bootstrap.
    """
    rows = {name: Errors.of(e) for name, e in errors.items()}
    if "with_effects" not in errors or "calibrated" not in errors:
        return Proof(errors, rows, None, False)
    before = np.linalg.norm(errors["calibrated"], axis=1)
    after = np.linalg.norm(errors["with_effects"], axis=1)
    means = _resampled(before - after, rng)
    low, high = np.percentile(means, [2.5, 97.5])
    better = _better(errors["calibrated"], errors["with_effects"], spread["with_effects"], rng)
    name = "with_effects" if better else "calibrated"
    misfit, excess = _misfit(errors[name], spread[name])
    left = {k: _misfit(errors[k], spread[k])[1] for k in ("calibrated", "with_effects")}
    share = 1.0 - (left["with_effects"] / max(left["calibrated"], 1e-12)) ** 2
    return Proof(errors, rows, (float(low), float(high)), better, misfit, excess, share)


def _better(
    before: np.ndarray, after: np.ndarray, spread: np.ndarray, rng: np.random.Generator
) -> bool:
    """Whether the squared errors, in units of the noise, fell beyond chance (95 %, one-sided).

    Where so few poses could not show an effect of the fitted size, though it be real, the errors
    must have fallen at all: then it is the evidence of the fitted rows that counts.
    """
    gain = ((before**2 - after**2) / spread**2).sum(axis=1)
    expected = float((((before - after) / spread) ** 2).sum())
    if expected < DECIDES:
        return bool(gain.sum() > 0)
    return bool(np.percentile(_resampled(gain, rng), 5.0) > 0)


def _misfit(error: np.ndarray, spread: np.ndarray) -> tuple[float, float]:
    """Median error over the expected (chi with 3 degrees), and the clipped RMS beyond it (m)."""
    ratio = float(np.median(np.linalg.norm(error / spread, axis=1)) / chi.median(3))
    limit = 3.0 * np.median(np.linalg.norm(error, axis=1))
    clipped = np.minimum(np.linalg.norm(error, axis=1), limit)
    return ratio, float(np.sqrt(max((clipped**2).mean() - (spread**2).sum(1).mean(), 0.0)))


def _resampled(gain: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Means over blocks drawn with replacement, (RESAMPLES,)."""
    blocks = np.array_split(gain, min(BLOCKS, len(gain)))
    sums = np.array([b.sum() for b in blocks])
    sizes = np.array([len(b) for b in blocks])
    drawn = rng.integers(len(blocks), size=(RESAMPLES, len(blocks)))
    return sums[drawn].sum(1) / sizes[drawn].sum(1)
