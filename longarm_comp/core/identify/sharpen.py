"""Forms that lie on a scale (a load gate, a time constant), between the values that were tried."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from scipy.optimize import minimize_scalar

from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.evidence import Score, score
from longarm_comp.core.identify.fit import Fit
from longarm_comp.core.identify.linear import Marginal

LOOKS = 14
"""Values looked at, at most."""
FINE = 0.02
"""A value is located to this share of the distance between the tried ones."""


def sharpened(
    fit: Fit, marginal: Marginal, columns: Columns, term: Term, candidates: Sequence[Candidate]
) -> Score:
    """The term in the form of highest evidence between the neighbouring tried values.

    Args:
        fit: whose rows, noise and weights count.
        marginal: what is in the model beside the term.
        columns: of candidates at the fit's rows.
        term: where it starts from; one without a scale is scored as it is.
        candidates: their values of the scale are the tried ones.
    """

    def at(value: float) -> Score:
        moved = dataclasses.replace(term, **{term.tunable: value})
        return score(fit, marginal, Candidate(term.name, (moved,)), columns)

    now = score(fit, marginal, Candidate(term.name, (term,)), columns)
    if not term.tunable:
        return now
    value = float(getattr(term, term.tunable))
    tried = {getattr(t, term.tunable) for c in candidates if c.name == term.name for t in c.terms}
    low = max((v for v in tried if v < value), default=value)
    high = min((v for v in tried if v > value), default=2.0 * value)
    if high <= low:
        return now
    found = minimize_scalar(
        lambda v: -at(float(v)).log_bayes_factor,
        bounds=(low, high),
        method="bounded",
        options={"maxiter": LOOKS, "xatol": FINE * (high - low)},
    )
    return max(now, at(float(found.x)), key=lambda s: s.log_bayes_factor)
