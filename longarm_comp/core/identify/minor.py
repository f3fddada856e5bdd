"""The practical size of an effect: what it is worth at the tip, beside how sure it is.

Many rows make the smallest effect certain.  One that moves the tip by less than anybody needs is
not named: it is taken out of the model again and listed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.candidates import CandidateColumns, Term
from longarm_comp.core.identify.evidence import (
    IMPLAUSIBLE,
    columns_at,
    key,
    marginal_without,
    shift_of,
)
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.search import SearchResult

SMALLEST_M = 5e-5
"""An effect that is worth less at the tip does not matter: no servo and no camera knows better."""
OF_SPREAD = 2e-4
"""On a small arm: the same as a share of the median distance of the sightings from their middle."""
OF_NOISE = 0.1
"""Nor does an effect matter that is worth less than this share of the noise."""
AT_BOUND = 1e-6
"""Distance from a bound, in prior standard deviations, that is none."""


@dataclass(frozen=True)
class Minor:
    """Terms of an effect that the data ask for, but that were taken out of the model again.

    Attributes:
        name: canonical name.
        where: places, in order.
        worth_m: RMS length at the tip that only they explain, m.
        why: in words.
        most_m: RMS length by which the rows may err more without them, m.
    """

    name: str
    where: tuple[str, ...]
    worth_m: float
    why: str
    most_m: float = math.inf

    @classmethod
    def of(
        cls, terms: tuple[Term, ...], worth_m: float, why: str, most_m: float = math.inf
    ) -> Minor:
        """Of terms of one effect."""
        where = tuple(dict.fromkeys(t.where for t in terms))
        return cls(terms[0].name, where, worth_m, why, most_m)


def worth(fit: ModelFit, columns: CandidateColumns, terms: Sequence[Term]) -> float:
    """RMS length at the tip (m) of what only some fitted terms explain.

    What the geometry and the other effects would take up without them is left out.

    Args:
        fit: that holds the terms.
        columns: of candidates at the fit's rows.
        terms: as fitted.
    """
    moved = shift_of(fit, columns, terms)
    marginal = marginal_without(fit, columns, {key(t) for t in terms})
    alone = marginal.project(fit.whitened(moved[..., None])[:, 0])
    return float(np.sqrt((fit.lengths(alone) ** 2).sum(1).mean()))


def share(fit: ModelFit, worth_m: float) -> float:
    """What an effect takes of the mean squared error that the fitted rows would have without it."""
    left = fit.residual[fit.weights > 0] * fit.metres
    return float(worth_m**2 / max(worth_m**2 + (left**2).sum(1).mean(), 1e-30))


def smallest(fit: ModelFit) -> float:
    """Worth (m) below which an effect does not matter."""
    rows = fit.session.take(fit.session.located)
    limit = SMALLEST_M
    if len(rows) > 1:
        middle = np.median(rows.xyz, axis=0)
        spread = np.median(np.linalg.norm(rows.xyz - middle, axis=1))
        limit = min(limit, OF_SPREAD * float(spread))
    return max(limit, OF_NOISE * noise_length(fit))


def noise_length(fit: ModelFit) -> float:
    """The noise of a row as a length at the tip, m."""
    return float(np.linalg.norm(fit.noise_m))


def settled(
    result: SearchResult, say: Callable[[str], None]
) -> tuple[SearchResult, tuple[Minor, ...]]:
    """The search's result without what does not matter or cannot be, and what was taken out."""
    return taken_out(result, _doubtful, say)


Doubtful = Callable[[SearchResult], Iterator[tuple[tuple[Term, ...], Minor]]]


def taken_out(
    result: SearchResult, doubtful: Doubtful, say: Callable[[str], None]
) -> tuple[SearchResult, tuple[Minor, ...]]:
    """The search's result without doubtful terms, the rest fitted again, and what was taken out.

    Terms stay where the rest could not do without them but with sizes that nobody believes, or
    where the refit shows that they were worth more than the linear estimate said: the rest may be
    held back by its bounds.

    Args:
        result: the search.
        doubtful: terms to take out next, each with the reason; asked again after each.
        say: told what is going on.
    """
    gone: list[Minor] = []
    needed: set[frozenset[tuple[str, str]]] = set()
    while True:
        for terms, minor in doubtful(result):
            places = frozenset(key(t) for t in terms)
            if places in needed:
                continue
            lighter = result.without(set(places))
            cheap = _cost(result.fit, lighter.fit) <= minor.most_m
            if cheap and _incredible(lighter) <= _incredible(result):
                say(f"without {minor.name} ({', '.join(minor.where)}): {minor.why}")
                gone.append(minor)
                result = lighter
                break
            needed.add(places)
        else:
            return result, tuple(gone)


def _cost(fit: ModelFit, lighter: ModelFit) -> float:
    """RMS length (m) by which the inliers err more in another fit."""
    inside = fit.weights > 0
    mine, theirs = (((f.residual[inside] * f.metres) ** 2).sum(1).mean() for f in (fit, lighter))
    return float(np.sqrt(max(theirs - mine, 0.0)))


def _incredible(result: SearchResult) -> set[tuple[object, ...]]:
    """Parameters of found effects of a size that nobody believes."""
    held = {key(t) for t in result.chosen}
    return {
        (*key(s.owner), s.parameter.name)
        for s in result.fit.slots
        if key(s.owner) in held
        and abs(getattr(s.owner, s.parameter.name)) > IMPLAUSIBLE * s.parameter.prior
    }


def families(result: SearchResult) -> dict[str, tuple[Term, ...]]:
    """The found terms, as fitted, by effect."""
    held = {key(t) for t in result.chosen}
    found: dict[str, list[Term]] = {}
    for term in result.fit.model.terms:
        if key(term) in held:
            found.setdefault(term.name, []).append(term)
    return {name: tuple(terms) for name, terms in found.items()}


def _doubtful(result: SearchResult) -> Iterator[tuple[tuple[Term, ...], Minor]]:
    """What is worth too little or at the limit of what is possible: effects, then single places.

    A place of an effect that jumps stays: at poses between the fitted ones it is of another size.
    So does one that the noise lets see: the effect is named in any case.
    """
    fit, columns, limit = result.fit, columns_at(result.fit), smallest(result.fit)
    seen = min(limit, OF_NOISE * noise_length(fit))
    found = families(result)
    options = [(terms, 1) for terms in found.values()]
    options += [
        ((t,), len(terms))
        for terms in found.values()
        for t in terms
        if len(terms) > 1 and t.continuous
    ]
    for terms, mates in options:
        length = worth(fit, columns, terms)
        why, most = _impossible(fit, terms[0]) if len(terms) == 1 else "", math.inf
        least = limit if mates == 1 else seen / np.sqrt(mates)
        if length < least:
            why = f"worth {1e3 * length:.2g} mm at the tip, too small to matter"
            most = least
        if why:
            yield terms, Minor.of(terms, length, why, most)


def _impossible(fit: ModelFit, term: Term) -> str:
    """Which parameter of a term is at the limit of what is possible, which 0 is not; or empty."""
    for p in term.parameters(fit.model.arm):
        value = float(getattr(term, p.name))
        if any(bound and abs(value - bound) < AT_BOUND * p.prior for bound in (p.lower, p.upper)):
            return f"{p.name} {value:.3g} {p.unit} is the limit of what is possible"
    return ""
