"""The result of the posterior: single effects with their credible sets, and functions on offer."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.special import expit, softmax

from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.effects.effect import Bias

CREDIBLE = 0.95
"""Probability that a credible set holds."""
UNNAMED = 1.0 - CREDIBLE
"""Probability, beforehand, of a cause that the library does not hold: what a set may leave out."""

NONE = -math.log(UNNAMED)
"""Log odds for no further effect, before the data: one finding in twenty may be wrong."""


@dataclass(frozen=True)
class ProposedFunction:
    """A function without a name on offer.

    Attributes:
        terms: its members; the prior standard deviation of each moves the tip by one noise.
        log_prior: log prior of the choice among all functions.
    """

    terms: tuple[Term, ...]
    log_prior: float


@dataclass(frozen=True)
class Rival:
    """Another name that may stand in the place of an effect.

    Attributes:
        candidate: its best places and form.
        log_bayes_factor: evidence for it there, beside the other effects.
        probability: probability that it is the cause, given that there is one.
        judged: the name whose evidence it has. Of names that no measurement distinguishes one is
            judged, and all share its probability.
        log_prior: its log prior, given that there is an effect; the choice of places is included.
        loose: as in `FoundEffect`.
    """

    candidate: Candidate
    log_bayes_factor: float
    probability: float
    judged: str = ""
    log_prior: float | None = None
    loose: bool = False

    @property
    def name(self) -> str:
        """The name of its effect class."""
        return self.candidate.name

    @property
    def unnamed(self) -> bool:
        """True for a function without a name, False for an effect of the library."""
        return not self.candidate.terms[0].searched

    @property
    def on_measuring_side(self) -> bool:
        """True for an effect that moves what is seen, not the tip."""
        return isinstance(self.candidate.terms[0], Bias)


@dataclass(frozen=True)
class FoundEffect:
    """A single effect that is there.

    Attributes:
        terms: the most probable terms, at the values that the posterior gives them.
        presence: probability that it is there.
        log_bayes_factor: evidence for it beside the other effects.
        chance: probability of its name, given that it is there.
        rivals: all other names that may stand in its place, the most probable first.
        where: places that explain it nearly as well; its own first.
        log_prior: as in `Rival`; None: that of any candidate of its name.
        loose: whether it is a function whose prior was widened to fit its amount once it was there.
    """

    terms: tuple[Term, ...]
    presence: float
    log_bayes_factor: float
    chance: float = 1.0
    rivals: tuple[Rival, ...] = ()
    where: tuple[tuple[str, ...], ...] = ()
    log_prior: float | None = None
    loose: bool = False

    @property
    def name(self) -> str:
        """The most probable name; for a function without a name, that of its effect class."""
        return self.terms[0].name

    @property
    def names(self) -> dict[str, float]:
        """Probability of every name, given that the effect is there; the effect's own name
        first."""
        return {self.name: self.chance} | {r.name: r.probability for r in self.rivals}

    @property
    def credible(self) -> tuple[str, ...]:
        """The smallest set of names that holds 95 % of the probability."""
        return smallest_set(self.names)

    @property
    def in_doubt(self) -> bool:
        """True where neither its presence nor its absence has a probability of 95 %."""
        return 1.0 - CREDIBLE <= self.presence < CREDIBLE

    @property
    def unnamed(self) -> bool:
        """True for a function without a name, False for an effect of the library."""
        return not self.terms[0].searched

    @property
    def chance_unnamed(self) -> float:
        """Probability that the cause has no name, given that the effect is there."""
        others = sum(r.probability for r in self.rivals if r.unnamed)
        return others + self.chance if self.unnamed else others

    @property
    def chance_seen(self) -> float:
        """Probability that it moves what is seen, not the tip, given that the effect is there."""
        others = sum(r.probability for r in self.rivals if r.on_measuring_side)
        return others + self.chance if isinstance(self.terms[0], Bias) else others

    @property
    def fitted_rivals(self) -> list[Rival]:
        """Rivals that are judged by a fit in its place: all that measurements distinguish from
        it."""
        return [r for r in self.rivals if r.name == r.judged != self.name]

    def compare_with(self, worth: Mapping[str, float]) -> tuple[FoundEffect, bool]:
        """Compare it with its fitted rivals.

        Args:
            worth: by name of a fitted rival: log evidence with it in this place, less that now.

        Returns:
            The effect with the probabilities that follow, led by the best name; and whether that is
            another effect.
        """
        if not worth:
            return self, False
        stays, *goes = softmax([0.0, *worth.values()]).tolist()
        chances = dict(zip(worth, goes, strict=True))
        mine = Rival(
            Candidate(self.name, self.terms),
            self.log_bayes_factor,
            self.chance,
            self.name,
            self.log_prior,
            self.loose,
        )
        every = [mine, *self.rivals]
        told = sum(r.probability for r in every if r.judged not in worth) or 1.0
        shared = Counter(r.judged for r in every)
        every = [
            replace(r, probability=stays * r.probability / told)
            if r.judged not in worth
            else replace(
                r,
                log_bayes_factor=self.log_bayes_factor + worth[r.judged],
                probability=chances[r.judged] / shared[r.judged],
            )
            for r in every
        ]
        best = max(every, key=lambda r: worth.get(r.name, 0.0))
        return self.put_first(best, [r for r in every if r is not best]), best is not every[0]

    def add_rival(self, other: FoundEffect, odds: float) -> FoundEffect:
        """Return the effect with one more rival, of an explanation that uses none of its names.

        Args:
            other: the effect that takes its place in that explanation.
            odds: log odds of that explanation against all that use one of its names.
        """
        share = float(expit(odds))
        worth = self.log_bayes_factor + odds
        rest = [replace(r, probability=(1.0 - share) * r.probability) for r in self.rivals]
        known = [r for r in rest if r.name == other.name]
        mine = Rival(Candidate(other.name, other.terms), worth, share, other.name)
        if known:
            mine = replace(known[0], probability=known[0].probability + share)
        rest = sorted(
            (mine, *(r for r in rest if r.name != other.name)), key=lambda r: -r.probability
        )
        return replace(self, chance=(1.0 - share) * self.chance, rivals=tuple(rest))

    def put_first(self, first: Rival, others: Sequence[Rival]) -> FoundEffect:
        """Return the effect with another name in the first place, and rivals beside it."""
        return replace(
            self,
            terms=first.candidate.terms,
            log_bayes_factor=first.log_bayes_factor,
            chance=first.probability,
            log_prior=first.log_prior,
            loose=first.loose,
            rivals=tuple(sorted(others, key=lambda r: -r.probability)),
        )


def keys_of(found: Iterable[FoundEffect]) -> set[tuple[str, str]]:
    """Return the keys (effect, place) of the terms of found effects."""
    return {t.key for f in found for t in f.terms}


def replace_effect(
    found: Sequence[FoundEffect], number: int, rival: FoundEffect
) -> tuple[FoundEffect, ...]:
    """Put a rival in the place of one effect, and of all other effects of the rival's name.

    Args:
        found: the effects of an explanation.
        number: position of the effect that the rival replaces.
        rival: it comes first in the new explanation.
    """
    rest = (f for k, f in enumerate(found) if k != number)
    return (rival, *(f for f in rest if rival.unnamed or f.name != rival.name))


K = TypeVar("K")


def smallest_set(chances: Mapping[K, float]) -> tuple[K, ...]:
    """Return the fewest keys, from the first on, that hold 95 % of the probability of all."""
    held = np.cumsum(list(chances.values())) / sum(chances.values())
    return tuple(chances)[: int((held < CREDIBLE).sum()) + 1]
