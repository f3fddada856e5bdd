"""Forms that lie on a scale (a load gate, a time constant), between the values that were tried."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.evidence import Score, score
from longarm_comp.core.identify.fit import Fit
from longarm_comp.core.identify.linear import Marginal

LOOKS = 9
"""Values looked at side by side; then as many again around the best of them."""
WORTH = 0.5
"""Log evidence that a form must bring to be taken instead of the one that is there."""
SWEEPS = 2
"""Times that every scale is gone along, where a term has several."""


def reshaped(terms: Sequence[Term], candidates: Sequence[Candidate]) -> list[Candidate]:
    """Other effects at the same places, in the forms that some terms were sharpened to.

    Only effects that have all of the terms' scales: a deadband and a play share their load gate.
    """
    scales = set(terms[0].tunable)
    if not scales:
        return []
    others: dict[str, dict[str, Term]] = {}
    for candidate in candidates:
        for term in candidate.terms:
            if term.name != terms[0].name and scales <= set(term.tunable):
                others.setdefault(term.name, {}).setdefault(term.where, term)
    made = []
    for name, at in others.items():
        shaped = tuple(
            dataclasses.replace(at[t.where], **{k: getattr(t, k) for k in scales})
            for t in terms
            if t.where in at
        )
        if len(shaped) == len(terms):
            made.append(Candidate(name, shaped))
    return made


def sharpened(
    fit: Fit, marginal: Marginal, columns: Columns, term: Term, candidates: Sequence[Candidate]
) -> Score:
    """The term in the form of highest evidence between the neighbouring tried values.

    As it is, where that is hardly better: a refit costs more than it brings.

    Args:
        fit: whose rows, noise and weights count.
        marginal: what is in the model beside the term.
        columns: of candidates at the fit's rows.
        term: where it starts from; one without scales is scored as it is.
        candidates: their values of the scales are the tried ones.
    """

    def scored(terms: Sequence[Term]) -> list[Score]:
        columns.of(terms)  # all at once: much faster
        return [score(fit, marginal, Candidate(term.name, (t,)), columns) for t in terms]

    start = best = scored([term])[0]
    for _ in range(min(len(term.tunable), SWEEPS)):
        for field in term.tunable:
            low, high = neighbours(term, field, candidates)
            for _ in range(2):
                here = best.candidate.terms[0]
                values = np.linspace(low, high, LOOKS)
                moved = [dataclasses.replace(here, **{field: float(v)}) for v in values]
                best = max(best, *scored(moved), key=lambda s: s.log_bayes_factor)
                step = (high - low) / (LOOKS - 1)
                centre = float(getattr(best.candidate.terms[0], field))
                low, high = max(low, centre - step), min(high, centre + step)
    return best if best.log_bayes_factor > start.log_bayes_factor + WORTH else start


def neighbours(term: Term, field: str, candidates: Sequence[Candidate]) -> tuple[float, float]:
    """The values of a scale that were tried to either side of a term's, or the scale's ends."""
    least, largest = term.tunable[field]
    value = float(getattr(term, field))
    tried = {float(getattr(t, field)) for c in candidates if c.name == term.name for t in c.terms}
    low = max((v for v in tried if v < value), default=least)
    high = min((v for v in tried if v > value), default=largest)
    return low, high
