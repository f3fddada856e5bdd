"""Forms on a scale: where the evidence is highest, and where most rows want a threshold.

A row on the wrong side of a threshold errs by the whole jump.  So it is set aside as an outlier,
and with it goes what would have moved the threshold.  Where a jump the other way would explain rows
that were set aside, the threshold is looked for again, each row counting no more than an outlier.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.evidence import FitColumns, shift_of
from longarm_comp.core.identify.linear import OUTLIER
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.posterior.offers import evidence_of_each

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


LOOKS = 7
"""Values looked at side by side; then as many again around the best of them, and so on."""
CLOSER = 4
"""Times: the last values are a thousandth of the range apart."""
WORTH = 0.5
"""Log evidence that a form must bring to be taken instead of the one that is there."""


def refined(
    fit: ModelFit, columns: FitColumns, term: Term, candidates: Sequence[Candidate]
) -> Term:
    """The term in the form of highest evidence between the neighbouring tried values.

    As it is, where that is hardly better: a refit costs more than it brings.

    Args:
        fit: that holds the term.
        columns: of candidates at the fit's rows.
        term: where it starts from.
        candidates: their values of the scales are the tried ones.
    """
    marginal = columns.without({term.key})

    def worth(terms: Sequence[Term]) -> np.ndarray:
        each = [Candidate(term.name, (t,)) for t in terms]
        return evidence_of_each(fit, marginal, columns, each)

    fields = list(term.scales())
    reach = np.array([neighbours(term, field, candidates) for field in fields])
    ends, least = reach.copy(), float(worth([term])[0]) + WORTH
    best, here = -math.inf, term
    for _ in range(CLOSER):
        values = [np.linspace(low, high, LOOKS) for low, high in reach]
        grid = np.array(list(itertools.product(*values)))
        found = worth([_at(term, fields, point) for point in grid])
        chances = np.exp(found - found.max())
        centre = chances @ grid / chances.sum()
        tried = [_at(term, fields, point) for point in (centre, grid[int(np.argmax(found))])]
        for moved, now in zip(tried, worth(tried).tolist(), strict=True):
            if now > best + WORTH:
                best, here = now, moved
        step = np.ptp(reach, axis=1) / (LOOKS - 1)
        centre = np.array([getattr(here, field) for field in fields])
        reach = np.clip(np.stack([centre - step, centre + step], axis=1), ends[:, :1], ends[:, 1:])
    return here if best > least else term


def _at(term: Term, fields: Sequence[str], values: np.ndarray) -> Term:
    return dataclasses.replace(term, **dict(zip(fields, values.tolist(), strict=True)))


def neighbours(term: Term, field: str, candidates: Sequence[Candidate]) -> tuple[float, float]:
    """The values of a scale that were tried to either side of a term's, or the scale's ends."""
    least, largest = term.scales()[field]
    value = float(getattr(term, field))
    tried = {float(getattr(t, field)) for c in candidates if c.name == term.name for t in c.terms}
    low = max((v for v in tried if v < value), default=least)
    high = min((v for v in tried if v > value), default=largest)
    return low, high
