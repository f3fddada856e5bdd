"""In practice: which model is written, and what a finding means.

Written is the model with the least error that a command may expect of it.  A finding has a size at
the tip and brings something on held-out rows.

The gain of one finding among several is that of the whole model over the model without it, the
rest fitted again (to first order), so that what geometry can take up does not count for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.candidates import Term
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit, priors
from longarm_comp.core.data.commanded import (
    as_commanded,
    commanded_errors,
    own_way,
    with_frame_shift,
)
from longarm_comp.core.data.measurement import errors, posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.identify.intervals import BLOCKS
from longarm_comp.core.identify.posterior.found import FoundEffect
from longarm_comp.core.model.model import Model


@dataclass(frozen=True)
class Gain:
    """Mean 3-D error on held-out rows before and after, m.

    Attributes:
        before, after: the means.
        ci95: of before - after, from the scatter of blocks of successive rows.
    """

    before: float
    after: float
    ci95: tuple[float, float]

    @classmethod
    def of(cls, before: np.ndarray, after: np.ndarray) -> Gain:
        """From the (M, 3) errors of two models on the same rows; zeros of no rows."""
        if not len(before):
            return cls(0.0, 0.0, (0.0, 0.0))
        long, short = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
        gain = long - short
        blocks = np.array_split(gain - gain.mean(), min(BLOCKS, len(gain)))
        off = np.array([block.sum() for block in blocks]) / len(gain)
        half = 1.96 * float(np.sqrt((off**2).sum() * len(off) / max(len(off) - 1, 1)))
        middle = float(gain.mean())
        return cls(float(long.mean()), float(short.mean()), (middle - half, middle + half))


@dataclass(frozen=True)
class Practical:
    """One finding in practice.

    Attributes:
        tip_m: (N,) what it moves the seen tip by at each fitted row.
        seen: held-out errors as measured, without it and with it.
        commanded: the same as a command would have it (`core/data/commanded.py`).
    """

    tip_m: np.ndarray
    seen: Gain
    commanded: Gain


def practical(
    fitted: ModelFit, findings: Sequence[Sequence[Term]], held_out: Session
) -> list[Practical]:
    """What the terms of each finding mean in practice.

    Args:
        fitted: the final fit, which holds the terms.
        findings: terms of each finding.
        held_out: rows that were not fitted.
    """
    if not findings:
        return []
    model = fitted.model
    tips = model.measured_at(fitted.posture)
    placed = held_out.take(held_out.placed)
    own = own_way(placed)
    at = posture(model, placed), posture(as_commanded(model), own)
    after = errors(model, placed, at[0]), commanded_errors(model, own, at[1])
    made = []
    for terms in findings:
        places = {t.key for t in terms}
        without = model.without(places)
        still = without.measured_at(without.posture_near(fitted.posture))
        # A first-order fit may overshoot; what is left without any fit is then nearer
        less = min(
            (refitted_without(fitted, places), without),
            key=lambda left: float(np.linalg.norm(errors(left, placed, at[0]))),
        )
        less = with_frame_shift(less, fitted.session)
        made.append(
            Practical(
                np.linalg.norm(tips - still, axis=1),
                Gain.of(errors(less, placed, at[0]), after[0]),
                Gain.of(commanded_errors(less, own, at[1]), after[1]),
            )
        )
    return made


def refitted_without(fitted: ModelFit, places: set[tuple[str, str]]) -> Model:
    """The model without the terms at some places, all others fitted again to first order."""
    marginal, left = FitColumns(fitted).without(places), fitted.model.without(places)
    free = np.array([not s.owner.through_others for s in left.slots], dtype=bool)
    kept = tuple(compress(left.slots, free))
    scale, values = priors(kept), np.array(left.values, dtype=float)
    lower = np.array([s.parameter.lower for s in kept]) / scale
    upper = np.array([s.parameter.upper for s in kept]) / scale
    values[free] = linear.solve(marginal.a, marginal.y, lower, upper).u * scale
    return left.with_values(values)


def expected_commanded(
    fits: Mapping[str, ModelFit], found: Sequence[FoundEffect]
) -> dict[str, float]:
    """RMS error (m) of a command by each model, expected under the posterior.

    By the rows that were fitted.  A row's residual is what the model leaves there, less the share
    that the fit took: twice the variance of the prediction is added, which is what it misses on a
    new row (Mallows' C_p).  What the measuring side is said to do moves what is seen, not the tip,
    with the probability that it is the measuring side that does it; otherwise a command errs by it.

    Args:
        fits: by name, on the same rows.
        found: single effects of the fullest of them.
    """
    ours = 1.0
    for f in found:
        if isinstance(f.terms[0], Bias):
            ours *= f.there * f.chance
    made = {}
    for name, fit in fits.items():
        rows = fit.session.take(fit.weights > 0)
        seen, told = errors(fit.model, rows), commanded_errors(fit.model, rows)
        square = ours * (seen**2).sum(1) + (1.0 - ours) * (told**2).sum(1)
        columns = fit.columns[fit.weights > 0] * fit.metres[:, None]
        variance = np.einsum("nip,pq,niq->n", columns, fit.covariance, columns, optimize=True)
        made[name] = float(np.sqrt(square.mean() + 2.0 * variance.mean()))
    return made


def least(expected: Mapping[str, float]) -> str:
    """The model to write; of equals the plainer one, which comes first."""
    return min(expected, key=lambda name: expected[name])
