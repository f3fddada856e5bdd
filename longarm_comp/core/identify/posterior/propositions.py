"""Functions without a name that are put on offer beside the library: the best of a large bank."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.discovered import COMPONENTS, Move, Turn
from longarm_comp.core.effects.quantities import AXES
from longarm_comp.core.effects.shapes import Function, Shape, Threshold, Wave
from longarm_comp.core.identify.discover.bank import (
    CAMERA,
    SHORTLIST,
    Bank,
    Hypothesis,
    banks,
    marginal_of,
    term_of,
)
from longarm_comp.core.identify.discover.functions import DENSE, nearby
from longarm_comp.core.identify.posterior.found import FoundEffect, Proposition

REFINED = 4
"""Candidates of a bank that are tried with other thresholds and frequencies; each of these pays for
the choice among as many."""


def propositions(fit: ModelFit, found: Sequence[FoundEffect]) -> tuple[Proposition, ...]:
    """The functions that explain most, on top of everything and in the place of what was found.

    Args:
        fit: geometry and what was found so far.
        found: these effects.
    """
    held = {t.key for f in found for t in f.terms}
    kept = np.array([s.owner.key not in held for s in fit.slots], dtype=bool)
    tops = [marginal_of(fit, some) for some in (kept, np.ones_like(kept))[: 2 if held else 1]]
    best: dict[Hypothesis, tuple[Bank, float]] = {}
    for bank in banks(fit):
        listed = bank.shortlisted(kept, [left for _, left in tops])
        for (marginal, _), kinds in zip(tops, listed, strict=True):
            weighed, each = [], SHORTLIST // len(kinds)  # or what is nearly alike crowds out others
            for few in kinds:
                tried = [h for h in few if not _geometric(h)]
                weighed += _weighed(bank, marginal, tried)[:each]
            weighed.sort(key=lambda one: -one[0])
            for worth, h in [*weighed, *_refined(bank, marginal, weighed[:REFINED])]:
                known = best.get(h)
                if known is None or worth > known[1]:
                    best[h] = bank, worth
    ordered = sorted(best.items(), key=lambda item: -item[1][1])[:SHORTLIST]
    return tuple(_proposed(bank, h) for h, (bank, worth) in ordered if worth > 0)


def _weighed(
    bank: Bank, marginal: Marginal, few: Sequence[Hypothesis]
) -> list[tuple[float, Hypothesis]]:
    """The log odds of each, the best first."""
    worth = bank.evidences(marginal, few).tolist()
    return sorted(zip(worth, few, strict=True), key=lambda each: -each[0])


def _geometric(hypothesis: Hypothesis) -> bool:
    """Whether it is a displacement that is always the same: an error of geometry or placement."""
    still = all(not function.factors for _, function in hypothesis.members)
    rigid = (isinstance(COMPONENTS.get(p.component), (Move, Turn)) for p, _ in hypothesis.members)
    seen = (p.at == CAMERA and p.component in AXES for p, _ in hypothesis.members)
    return still and all(a or b for a, b in zip(rigid, seen, strict=True))


def _proposed(bank: Bank, hypothesis: Hypothesis) -> Proposition:
    """Its terms; a unit of each prior moves the rows by one noise, rms, times its decay."""
    scales = np.array(hypothesis.decay) / bank.sizes(hypothesis)
    terms = tuple(
        term_of(place, f.text, f.domain, float(scale))
        for (place, f), scale in zip(hypothesis.members, scales, strict=True)
    )
    return Proposition(terms, hypothesis.log_prior)


def _refined(
    bank: Bank, marginal: Marginal, first: Sequence[tuple[float, Hypothesis]]
) -> Iterator[tuple[float, Hypothesis]]:
    """Candidates with other thresholds or frequencies, closer and closer to the best."""
    for best in first:
        prior = best[1].log_prior - math.log(REFINED)
        for width in (1.0, 2.0 / (DENSE - 1)):  # then between the neighbours of the best
            tried = (dataclasses.replace(h, log_prior=prior) for h in _around(bank, best[1], width))
            best = max((best, *_weighed(bank, marginal, list(tried))), key=lambda each: each[0])
        yield best


def _around(bank: Bank, hypothesis: Hypothesis, width: float) -> Iterator[Hypothesis]:
    """The same candidate with thresholds or frequencies near its own."""
    factors = dict.fromkeys(f for _, function in hypothesis.members for f in function.factors)
    bent = [f for f in factors if isinstance(f, (Threshold, Wave))]
    if len(bent) == 1 or all(isinstance(f, Wave) for f in bent):
        by_name = bank.functions.inputs.by_name
        for moved in zip(*(nearby(f, by_name[f.of], width) for f in bent), strict=True):
            other: dict[Shape, Shape] = dict(zip(bent, moved, strict=True))
            members = tuple(
                (place, Function(tuple(other.get(f, f) for f in function.factors)))
                for place, function in hypothesis.members
            )
            yield dataclasses.replace(hypothesis, members=members)
