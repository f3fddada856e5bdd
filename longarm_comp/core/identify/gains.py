"""The size of a finding at the tip, and its gain on held-out rows.

The gain of a finding is the difference between the error of the model without it, all other terms
fitted again (to first order), and that of the whole model. So the part of its shift that the
geometry can explain does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
from scipy.special import stdtrit

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit, prior_bounds, prior_widths
from longarm_comp.core.data.commanded import (
    as_commanded,
    commanded_errors,
    is_known_to_command,
    own_way,
    with_frame_shift,
)
from longarm_comp.core.data.holdout import BLOCKS
from longarm_comp.core.data.measurement import compute_posture, compute_tip_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model


@dataclass(frozen=True)
class Gain:
    """Mean 3-D error on held-out rows before and after, m.

    Attributes:
        before, after: the mean errors, m.
        ci95: 95 % interval of before - after, m: the widest by the scatter of blocks of successive
            rows, or of folds, whose rows share their models (Student's t).
    """

    before: float
    after: float
    ci95: tuple[float, float]

    @classmethod
    def of(cls, before: np.ndarray, after: np.ndarray, fold: np.ndarray) -> Gain:
        """Compute the gain from the (M, 3) errors, m, of two models on the same rows."""
        return cls.of_lengths(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1), fold)

    @classmethod
    def of_lengths(cls, before: np.ndarray, after: np.ndarray, fold: np.ndarray) -> Gain:
        """Compute the gain from the (M,) lengths of the errors of two models on the same rows.

        The lengths are `before` and `after`, m; `fold` (M,) numbers the folds.
        """
        if not len(before):
            return cls(0.0, 0.0, (0.0, 0.0))
        means, rows = (float(before.mean()), float(after.mean())), len(before)
        gain = means[0] - means[1]
        block = np.arange(rows) * min(BLOCKS, rows) // rows
        half = max(_half_interval(before - after - gain, each) for each in (block, fold))
        if rows == 1:  # it leaves everything possible
            half = sum(means)
        return cls(*means, (gain - half, gain + half))


def _half_interval(deviation: np.ndarray, cluster: np.ndarray) -> float:
    """Return half of the 95 % interval of a mean by the scatter of clusters; 0 if there is one.

    `deviation` (M,) are the values minus their mean, `cluster` (M,) the numbers of their clusters.
    """
    names, at = np.unique(cluster, return_inverse=True)
    free = len(names) - 1
    if not free:
        return 0.0
    sums = np.bincount(at, deviation) / len(deviation)
    return float(stdtrit(free, 0.975) * np.sqrt((sums**2).sum() * len(names) / free))


def measure_tip_shift(fitted: ModelFit, places: set[tuple[str, str]]) -> np.ndarray:
    """Return the (N,) shift, m, of the seen tip by the terms of some keys, at each fitted row."""
    still = fitted.model.without(places)
    moved = fitted.model.measured_at(fitted.posture)
    return np.linalg.norm(moved - still.measured_at(still.posture_near(fitted.posture)), axis=1)


def compute_gains(
    held_out: Sequence[tuple[ModelFit, Session]], each: Sequence[set[tuple[str, str]]]
) -> list[tuple[Gain, Gain]]:
    """Compute the gains of each finding on held-out rows.

    Args:
        held_out: fits without some rows, and these rows.
        each: keys (effect, place) of the terms of each finding.

    Returns:
        For each finding the gain in errors as seen, and that in errors as commanded.
    """
    placed = [(fit, rows.take(rows.placed)) for fit, rows in held_out]
    errors = np.concatenate([_errors_without_each(fit, each, rows) for fit, rows in placed], 3)
    fold = np.repeat(np.arange(len(placed)), [len(rows) for _, rows in placed])
    return [
        (Gain.of(seen[0], seen[1], fold), Gain.of(commanded[0], commanded[1], fold))
        for seen, commanded in errors
    ]


def _errors_without_each(
    fitted: ModelFit, each: Sequence[set[tuple[str, str]]], rows: Session
) -> np.ndarray:
    """Compute the errors at M rows without and with the terms of each of F findings, m.

    Returns (F, 2, 2, M, 3): as seen, then as commanded; without the terms, then with them.
    """
    made = np.zeros((len(each), 2, 2, len(rows), 3))
    if not len(rows):
        return made
    model = fitted.model
    at = commanded_at = compute_posture(model, rows)
    if not is_known_to_command(model, rows):
        commanded_at = compute_posture(as_commanded(model), own_way(rows))
    made[:, 0] = seen = compute_tip_errors(model, rows, at)
    made[:, 1] = commanded_errors(model, rows, commanded_at, seen)
    for places, errors in zip(each, made, strict=True):
        if places.isdisjoint(t.key for t in model.terms):
            continue
        # A first-order fit may overshoot; the model without any new fit is then better
        tried = (refit_without(fitted, places), model.without(places))
        missed = [compute_tip_errors(less, rows, at) for less in tried]
        nearest = int(np.argmin([np.linalg.norm(error) for error in missed]))
        less = with_frame_shift(tried[nearest], fitted.session, fitted.posture)
        seen = missed[nearest]
        errors[:, 0] = seen, commanded_errors(less, rows, commanded_at, seen)
    return made


def refit_without(fitted: ModelFit, places: set[tuple[str, str]]) -> Model:
    """Return the model without the terms of some keys, all others fitted again to first order.

    Background effects keep their values; otherwise they would replace the terms that are left out.
    """
    shares = dict(fitted.model.beyond)
    background = {s.owner.key for s in fitted.slots if shares.get(s.identity, 1.0) < 1.0} - places
    marginal = FitColumns(fitted).marginal_without(places, still=background)
    left = fitted.model.without(places)
    owners = [s.owner for s in left.slots]
    free = np.array([not o.through_others and o.key not in background for o in owners])
    kept = tuple(compress(left.slots, free))
    values = np.array(left.values, dtype=float)
    found = linear.solve_posterior(marginal.a, marginal.y, *prior_bounds(kept))
    values[free] = found.u * prior_widths(kept)
    return left.with_values(values)
