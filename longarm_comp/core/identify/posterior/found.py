"""What the posterior says: single effects with their credible sets, and functions on offer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate, Term

CREDIBLE = 0.95
"""Probability that a credible set holds."""
UNNAMED = 1.0 - CREDIBLE
"""Probability, beforehand, of a cause that the library does not hold: what a set may leave out."""
OVERFLOW = 700.0  # the largest exponent of a float


@dataclass(frozen=True)
class Proposition:
    """A function without a name on offer.

    Attributes:
        terms: its members, each with the prior standard deviation of one noise at the tip.
        log_prior: of the choice among all functions.
    """

    terms: tuple[Term, ...]
    log_prior: float


@dataclass(frozen=True)
class FoundEffect:
    """A single effect that is there.

    Attributes:
        terms: the most probable instances, at the values that the posterior gives them.
        there: probability that it is there.
        names: (name, probability) given that it is there, most probable first; of functions
            without a name the name of their effect class.
        log_bayes_factor: of it on top of the others.
        rivals: the best candidate of every other name in the credible set, with its log Bayes
            factor in the place of this effect.
        where: places that explain it nearly alike; its own first.
        alike: groups of names that no measurement distinguishes; the first of each is judged, the
            others share its probability. Its own group comes first.
    """

    terms: tuple[Term, ...]
    there: float
    names: tuple[tuple[str, float], ...]
    log_bayes_factor: float
    rivals: tuple[tuple[Candidate, float], ...] = ()
    where: tuple[tuple[str, ...], ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()

    @property
    def name(self) -> str:
        """The most probable name."""
        return self.terms[0].name

    @property
    def in_doubt(self) -> bool:
        """Whether neither that it is there nor that it is not is credible."""
        return 1.0 - CREDIBLE <= self.there < CREDIBLE

    @property
    def unnamed(self) -> bool:
        """Whether it is a function without a name."""
        return not self.terms[0].searched

    @property
    def chance_unnamed(self) -> float:
        """Probability, given that it is there, of a cause that has no name."""
        held = {c.name for c, _ in self.rivals if not c.terms[0].searched}
        held |= {self.name} if self.unnamed else set()
        return sum(chance for name, chance in self.names if name in held)

    def fitted_rivals(self) -> list[Candidate]:
        """Rivals whose worth only a fit in its place tells: one of each group.

        Of what no measurement distinguishes from it, and of functions, which need no other effect,
        the columns tell all.
        """
        judged = (c for c, _ in self.rivals if c.name == self._group(c.name)[0])
        return [c for c in judged if c.name not in self._told_by_columns]

    @property
    def _told_by_columns(self) -> set[str]:
        functions = (c.name for c, _ in self.rivals if not c.terms[0].searched)
        return {*self._group(self.name), *functions}

    def _group(self, name: str) -> tuple[str, ...]:
        """A name and those that no measurement distinguishes from it, the judged one first."""
        return next((group for group in self.alike if name in group), (name,))

    def against(self, worth: Mapping[str, float]) -> tuple[FoundEffect, bool]:
        """With the probabilities of fits; what is best leads. Whether that is another effect.

        Args:
            worth: by name of a rival, log evidence in its place, fitted, less the evidence now.
        """
        if not worth:
            return self, False
        told = self._told_by_columns
        share = {n: p for n, p in self.names if n in told}
        total = sum(share.values()) or 1.0
        odds = {n: math.exp(min(w, OVERFLOW)) for n, w in worth.items()}
        whole = 1.0 + sum(odds.values())
        names = {n: p / total / whole for n, p in share.items()}
        for name, o in odds.items():
            group = self._group(name)
            names |= dict.fromkeys(group, o / whole / len(group))
        factors = [worth.get(self._group(c.name)[0], 0.0) for c, _ in self.rivals]
        rivals = [
            (c, self.log_bayes_factor + factor)
            for (c, _), factor in zip(self.rivals, factors, strict=True)
        ]
        best, terms = max(worth, key=lambda name: worth[name]), self.terms
        better = worth[best] > 0
        if better:
            terms = next(c.terms for c, _ in rivals if c.name == best)
            rivals = [(c, factor) for c, factor in rivals if c.name != best]
            rivals.insert(0, (Candidate(self.name, self.terms), self.log_bayes_factor))
        ordered = tuple(sorted(names.items(), key=lambda c: (c[0] != terms[0].name, -c[1])))
        return replace(self, terms=terms, names=ordered, rivals=tuple(rivals)), better

    @property
    def credible(self) -> tuple[str, ...]:
        """The smallest set of names that holds 95 % of the probability."""
        return smallest_set(dict(self.names))


def instead(
    found: Sequence[FoundEffect], number: int, rival: FoundEffect
) -> tuple[FoundEffect, ...]:
    """Effects with a rival in the place of one, and of what there is of its own name."""
    rest = (f for k, f in enumerate(found) if k != number)
    return (rival, *(f for f in rest if rival.unnamed or f.name != rival.name))


K = TypeVar("K")


def smallest_set(chances: Mapping[K, float]) -> tuple[K, ...]:
    """The fewest, in their order, that hold 95 % of the probability of all."""
    held = np.cumsum(list(chances.values())) / sum(chances.values())
    return tuple(chances)[: int((held < CREDIBLE).sum()) + 1]
