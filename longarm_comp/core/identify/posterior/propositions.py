"""Functions without a name that are put on offer beside the library: the best of a large bank."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from longarm_comp.core.effects.components import COMPONENTS, Move, Turn
from longarm_comp.core.effects.quantities import AXES
from longarm_comp.core.identify.candidates import Term
from longarm_comp.core.identify.discover.bank import (
    Bank,
    Hypothesis,
    Weighed,
    around,
    marginal_of,
    weight,
)
from longarm_comp.core.identify.discover.banks import CAMERA, banks, term_of
from longarm_comp.core.identify.discover.screening import Screening
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.posterior.found import Proposition

SCREENED = 12
"""Candidates of a bank and kind that are scored exactly."""
REFINED = 4
"""Of these, how many are tried with other thresholds and frequencies."""
MOST = 60
"""Functions on offer at most; the best of them share what the data say for functions."""
WIDTHS = (1.0, 0.08)
"""Reach of these looks, in steps between the values tried first."""
LOOKS = np.log(4.0)
"""Log odds paid for them."""


class HasTerms(Protocol):
    @property
    def terms(self) -> tuple[Term, ...]: ...


def propositions(fit: ModelFit, found: Sequence[HasTerms]) -> tuple[Proposition, ...]:
    """The functions that explain most, on top of everything and in the place of what was found.

    Args:
        fit: geometry and what was found so far.
        found: these effects.
    """
    every = banks(fit)
    screened = [Screening(bank, fit) for bank in every]
    held = {t.key for f in found for t in f.terms}
    gone = [set(), held] if held else [held]
    best: dict[Hypothesis, tuple[Bank, float]] = {}
    for places in gone:
        kept = np.array([s.owner.key not in places for s in fit.slots], dtype=bool)
        marginal, py = marginal_of(fit, kept)
        for bank, screening in zip(every, screened, strict=True):
            first = [bank.score(marginal, fit, c) for c in screening.best(kept, py, SCREENED)]
            first.sort(key=lambda w: -w.log_evidence)
            for weighed in [*first, *_refined(bank, marginal, fit, first[:REFINED])]:
                known = best.get(weighed.candidate)
                if _geometric(weighed.candidate):
                    continue
                if known is None or weighed.log_evidence > known[1]:
                    best[weighed.candidate] = bank, weighed.log_evidence
    ordered = sorted(best.items(), key=lambda item: -item[1][1])[:MOST]
    return tuple(_proposed(fit, bank, h) for h, (bank, worth) in ordered if worth > 0)


def _geometric(hypothesis: Hypothesis) -> bool:
    """Whether it is a displacement that is always the same: an error of geometry or placement."""
    still = all(not function.factors for function in hypothesis.functions)
    rigid = (isinstance(COMPONENTS.get(p.component), (Move, Turn)) for p, _ in hypothesis.members)
    seen = (p.at == CAMERA and p.component in AXES for p, _ in hypothesis.members)
    return still and all(a or b for a, b in zip(rigid, seen, strict=True))


def _proposed(fit: ModelFit, bank: Bank, hypothesis: Hypothesis) -> Proposition:
    """Its terms; a unit of each prior moves the rows by one noise, rms, times its decay."""
    columns = bank.columns(hypothesis.members) * weight(fit)[..., None]
    rows = max(float((fit.weights > 0).sum()), 1.0)
    size = np.sqrt(np.maximum((columns**2).sum((0, 1)) / rows, 1e-300))
    terms = tuple(
        term_of(place, f.text, f.domain, decay / float(s))
        for (place, f), s, decay in zip(hypothesis.members, size, hypothesis.decay, strict=True)
    )
    return Proposition(terms, hypothesis.log_prior)


def _refined(
    bank: Bank, marginal: Marginal, fit: ModelFit, first: Sequence[Weighed]
) -> Iterator[Weighed]:
    """Candidates with other thresholds or frequencies, closer and closer to the best."""
    for best in first:
        prior = best.candidate.log_prior - LOOKS
        for width in WIDTHS:
            tried = [
                bank.score(marginal, fit, dataclasses.replace(c, log_prior=prior))
                for c in around(bank, best.candidate, width)
            ]
            best = max((best, *tried), key=lambda w: w.log_evidence)
        yield best
