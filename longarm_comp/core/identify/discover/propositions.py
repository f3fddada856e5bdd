"""Functions without a name that are put on offer beside the library: the best of a large bank."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from longarm_comp.core.effects.function import Function
from longarm_comp.core.effects.shapes import Threshold, Wave
from longarm_comp.core.identify.candidates import Term
from longarm_comp.core.identify.discover.bank import (
    Bank,
    Hypothesis,
    Weighed,
    weight,
    whitened_design,
)
from longarm_comp.core.identify.discover.banks import banks, term_of
from longarm_comp.core.identify.discover.functions import nearby
from longarm_comp.core.identify.discover.screening import Screening
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.offers import Proposition

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
        kept = np.array([s.owner.key not in places for s in fit.slots])
        marginal, py = _marginal(fit, kept)
        for bank, screening in zip(every, screened, strict=True):
            first = [bank.score(marginal, fit, c) for c in screening.best(kept, py, SCREENED)]
            first.sort(key=lambda w: -w.log_evidence)
            for weighed in [*first, *_refined(bank, marginal, fit, first[:REFINED])]:
                held = best.get(weighed.candidate)
                if held is None or weighed.log_evidence > held[1]:
                    best[weighed.candidate] = bank, weighed.log_evidence
    ordered = sorted(best.items(), key=lambda item: -item[1][1])[:MOST]
    return tuple(_proposed(fit, bank, h) for h, (bank, worth) in ordered if worth > 0)


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
                for c in _around(bank, best.candidate, width)
            ]
            best = max((best, *tried), key=lambda w: w.log_evidence)
        yield best


def _around(bank: Bank, candidate: Hypothesis, width: float) -> Iterator[Hypothesis]:
    """The same candidate with thresholds or frequencies near its own."""
    factors = dict.fromkeys(f for function in candidate.functions for f in function.factors)
    bent = [f for f in factors if isinstance(f, (Threshold, Wave))]
    by_name = bank.functions.inputs.by_name
    if len(bent) == 1:
        for other in nearby(bent[0], by_name[bent[0].of], width):
            yield _renamed(candidate, {bent[0]: other})
    elif len(bent) == 2 and all(isinstance(f, Wave) for f in bent):
        first, second = (nearby(f, by_name[f.of], width) for f in bent)
        for pair in zip(first, second, strict=True):
            yield _renamed(candidate, dict(zip(bent, pair, strict=True)))


def _renamed(candidate: Hypothesis, other: dict) -> Hypothesis:
    members = tuple(
        (place, Function(tuple(other.get(f, f) for f in function.factors)))
        for place, function in candidate.members
    )
    return dataclasses.replace(candidate, members=members)


def _marginal(fit: ModelFit, kept: np.ndarray) -> tuple[Marginal, np.ndarray]:
    """Evidence on top of some of the model's columns, and (N, d) what these leave, whitened."""
    inside = fit.weights > 0
    weights = weight(fit)
    design = whitened_design(fit)[inside]
    data = (fit.residual + fit.columns @ fit.model.values) * weights
    marginal = Marginal(design.reshape(-1, design.shape[-1])[:, kept], data[inside].ravel())
    left = np.zeros(data.shape)
    left[inside] = marginal.py.reshape(-1, data.shape[1])
    return marginal, left
