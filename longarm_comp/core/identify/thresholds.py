"""Thresholds of switches: where most rows want them.

A row on the wrong side of a threshold errs by the whole jump.  So it is set aside as an outlier,
and with it goes what would have moved the threshold.  Where a jump the other way would explain rows
that were set aside, the threshold is looked for again, each row counting no more than an outlier.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from longarm_comp.core.identify.candidates import Term
from longarm_comp.core.identify.evidence import FitColumns, shift_of
from longarm_comp.core.identify.linear import OUTLIER
from longarm_comp.core.identify.model_fit import ModelFit

VALUES = 33
"""Values looked at over the whole range, then as many again around the best."""
GAIN = 12.0
"""Squared error, in units of the noise, that must be gained: odds of 400, for as many looks."""


def retuned(fit: ModelFit, columns: FitColumns, term: Term) -> Term:
    """The term with the thresholds that most rows agree on; itself where that is hardly better."""
    aside = fit.weights == 0
    scales = term.scales()
    ends = [
        dataclasses.replace(term, **{field: float(end)})
        for field, pair in scales.items()
        for end in pair
    ]
    if not aside.any() or not ends:
        return term
    now = _cost(fit, columns, term, term)
    explained = np.max([now - _cost(fit, columns, term, other) for other in ends], axis=0)
    if explained[aside].clip(0.0).sum() < GAIN:
        return term
    sharp = dataclasses.replace(term, **{field: low for field, (low, _) in scales.items()})
    found = [_agreed(fit, columns, term, start) for start in (term, sharp)]
    cost, best = min(found, key=lambda pair: pair[0])
    return best if cost < now.sum() - GAIN else term


def _agreed(fit: ModelFit, columns: FitColumns, term: Term, start: Term) -> tuple[float, Term]:
    """Least cost of a form, from a start along one scale after the other, and the form."""
    cost, best = float(_cost(fit, columns, term, start).sum()), start
    for field, (lower, upper) in term.scales().items():
        low, high = lower, upper
        for _ in range(2):
            values = np.linspace(low, high, VALUES)
            others = [dataclasses.replace(best, **{field: float(v)}) for v in values]
            columns.of(others)  # all at once: much faster
            costs = [float(_cost(fit, columns, term, other).sum()) for other in others]
            k = int(np.argmin(costs))
            if costs[k] < cost:
                cost, best = costs[k], others[k]
            step = (high - low) / (VALUES - 1)
            centre = float(getattr(best, field))
            low, high = max(lower, centre - step), min(upper, centre + step)
    return cost, best


def _cost(fit: ModelFit, columns: FitColumns, now: Term, then: Term) -> np.ndarray:
    """(N,) squared errors in units of the noise with another form of a term, outliers clipped."""
    moved = shift_of(fit, columns, [then]) - shift_of(fit, columns, [now])
    noise = fit.uneven(fit.session)[:, None] * fit.sigma
    white = np.nan_to_num((fit.residual - moved) / noise)
    return np.asarray(np.minimum((white**2).sum(axis=1), OUTLIER**2))
