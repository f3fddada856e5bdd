"""What a finding means in practice: its size at the tip, and what it brings on held-out rows.

The gain of one finding among several is that of the whole model over the model without it, the
rest fitted again (to first order), so that what geometry can take up does not count for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.data.commanded import as_commanded, own_way
from longarm_comp.core.data.measurement import errors, posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify import linear
from longarm_comp.core.identify.candidates import Term
from longarm_comp.core.identify.evidence import columns_at
from longarm_comp.core.identify.intervals import BLOCKS
from longarm_comp.core.identify.model_fit import ModelFit, priors
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
    told, placed = as_commanded(model), held_out.take(held_out.placed)
    own = own_way(placed)
    at = posture(model, placed), posture(told, own)
    after = errors(model, placed, at[0]), errors(told, own, at[1])
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
        made.append(
            Practical(
                np.linalg.norm(tips - still, axis=1),
                Gain.of(errors(less, placed, at[0]), after[0]),
                Gain.of(errors(as_commanded(less), own, at[1]), after[1]),
            )
        )
    return made


def refitted_without(fitted: ModelFit, places: set[tuple[str, str]]) -> Model:
    """The model without the terms at some places, all others fitted again to first order."""
    marginal = columns_at(fitted).without(places)
    kept = tuple(s for s in fitted.slots if s.owner.key not in places)
    scale = priors(kept)
    lower = np.array([s.parameter.lower for s in kept]) / scale
    upper = np.array([s.parameter.upper for s in kept]) / scale
    found = linear.solve(marginal.a, marginal.y, lower, upper)
    return fitted.model.without(places).with_values(found.u * scale)
