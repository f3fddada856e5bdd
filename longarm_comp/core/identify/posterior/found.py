"""Found effects with their credible sets of names, their rivals, and proposed functions."""

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
"""Probability that a credible set must hold, and that a finding must have."""
UNNAMED = 1.0 - CREDIBLE
"""Prior probability that a cause is not in the library."""

NONE = -math.log(UNNAMED)
"""Prior log odds of no further effect against one: one finding in twenty may be wrong."""


@dataclass(frozen=True)
class ProposedFunction:
    """A function without a name that is on offer.

    Attributes:
        terms: its terms. One prior standard deviation of each moves the rows by about one standard
            deviation of the noise.
        log_prior: log prior of the choice among all functions.
    """

    terms: tuple[Term, ...]
    log_prior: float


@dataclass(frozen=True)
class PossibleCause:
    """A name that an effect may have, at its best places and in its best form.

    Attributes:
        candidate: these places and this form, with estimated values.
        log_bayes_factor: evidence for it there, beside the other effects.
        probability: probability that it is the cause, given that there is one.
        judged: the name whose evidence it has. If no measurement distinguishes some names, one of
            them is judged, and they share its probability.
        log_prior: its log prior, given that there is an effect; the choice of places is included.
            None: that of any candidate of its name.
        loose: whether it is a function whose prior was widened to its amount (`widen_prior`).
    """

    candidate: Candidate
    log_bayes_factor: float
    probability: float = 1.0
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


@dataclass(frozen=True)
class FoundEffect:
    """A single effect that was found, with all names that it may have.

    Attributes:
        causes: its possible causes: the one in the model, then its rivals, the most probable first.
        presence: probability that the effect exists.
        where: sets of places that explain the data nearly as well; its own set first.
        otherwise: its other places and forms, with the log odds of each against its own.
    """

    causes: tuple[PossibleCause, ...]
    presence: float
    where: tuple[tuple[str, ...], ...] = ()
    otherwise: tuple[tuple[Candidate, float], ...] = ()

    @classmethod
    def of(
        cls,
        terms: tuple[Term, ...],
        presence: float,
        log_bayes_factor: float,
        log_prior: float | None = None,
    ) -> FoundEffect:
        """Make an effect that has no rivals."""
        candidate = Candidate(terms[0].name, terms)
        return cls((PossibleCause(candidate, log_bayes_factor, log_prior=log_prior),), presence)

    @property
    def cause(self) -> PossibleCause:
        """The cause in the model."""
        return self.causes[0]

    @property
    def rivals(self) -> tuple[PossibleCause, ...]:
        """All other names that may be true instead, the most probable first."""
        return self.causes[1:]

    @property
    def name(self) -> str:
        """The name of the cause in the model; of a function, that of its effect class."""
        return self.cause.name

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms of the cause in the model."""
        return self.cause.candidate.terms

    @property
    def unnamed(self) -> bool:
        """True for a function without a name, False for an effect of the library."""
        return self.cause.unnamed

    @property
    def log_bayes_factor(self) -> float:
        """The evidence for the cause in the model, beside the other effects."""
        return self.cause.log_bayes_factor

    @property
    def names(self) -> dict[str, float]:
        """Probability of every name, given that the effect exists; its own name first."""
        return {c.name: c.probability for c in self.causes}

    @property
    def credible(self) -> tuple[str, ...]:
        """The smallest set of names that holds 95 % of the probability."""
        return smallest_set(self.names)

    @property
    def in_doubt(self) -> bool:
        """True where neither its presence nor its absence has a probability of 95 %."""
        return 1.0 - CREDIBLE <= self.presence < CREDIBLE

    @property
    def chance_unnamed(self) -> float:
        """Probability that the cause has no name, given that the effect exists."""
        return sum(c.probability for c in self.causes if c.unnamed)

    @property
    def chance_bias(self) -> float:
        """Probability that it moves the sighting, not the tip, given that the effect exists."""
        biases = (c for c in self.causes if isinstance(c.candidate.terms[0], Bias))
        return sum(c.probability for c in biases)

    @property
    def fitted_rivals(self) -> list[PossibleCause]:
        """The rivals to judge by a fit: one of each group that measurements distinguish from it."""
        return [r for r in self.rivals if r.name == r.judged != self.name]

    def compare_with(self, worth: Mapping[str, float]) -> tuple[FoundEffect, bool]:
        """Update the probabilities of all names after fits of the rivals.

        Args:
            worth: by name of a fitted rival: log evidence with it in this place, less that of the
                present effect.

        Returns:
            The effect with the new probabilities, under the best name; and whether this name is
            another one.
        """
        if not worth:
            return self, False
        stays, *goes = softmax([0.0, *worth.values()]).tolist()
        chances = dict(zip(worth, goes, strict=True))
        every = [replace(self.cause, judged=self.name), *self.rivals]
        unfitted = sum(r.probability for r in every if r.judged not in worth) or 1.0
        shared = Counter(r.judged for r in every)
        every = [
            replace(r, probability=stays * r.probability / unfitted)
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
        known = [replace(c, probability=(1.0 - share) * c.probability) for c in self.causes]
        rivals = {c.name: c for c in known[1:]}
        worth = self.log_bayes_factor + odds
        new = PossibleCause(other.cause.candidate, worth, 0.0, other.name)
        new = rivals.get(other.name, new)
        rivals[other.name] = replace(new, probability=new.probability + share)
        return self.put_first(known[0], rivals.values())

    def put_first(self, first: PossibleCause, others: Iterable[PossibleCause]) -> FoundEffect:
        """Return the effect under the name of `first`, with the others as its rivals."""
        rivals = sorted(others, key=lambda r: -r.probability)
        same = first.name == self.name
        return replace(self, causes=(first, *rivals), otherwise=self.otherwise if same else ())

    def with_terms(self, terms: Iterable[Term], loose: bool = False) -> FoundEffect:
        """Return the effect with other values or forms, or a wider prior, of the same terms."""
        candidate = Candidate(self.name, tuple(terms))
        first = replace(self.cause, candidate=candidate, loose=loose or self.cause.loose)
        return replace(self, causes=(first, *self.rivals))


def keys_of(found: Iterable[FoundEffect]) -> set[tuple[str, str]]:
    """Return the keys (effect, place) of the terms of found effects."""
    return {t.key for f in found for t in f.terms}


def replace_effect(
    found: Sequence[FoundEffect], number: int, rival: FoundEffect
) -> tuple[FoundEffect, ...]:
    """Return an explanation in which a rival replaces one effect.

    A named rival also replaces all other effects of its name.

    Args:
        found: the effects of an explanation.
        number: position of the effect that is replaced.
        rival: it comes first in the new explanation.
    """
    rest = (f for k, f in enumerate(found) if k != number)
    return (rival, *(f for f in rest if rival.unnamed or f.name != rival.name))


K = TypeVar("K")


def smallest_set(chances: Mapping[K, float]) -> tuple[K, ...]:
    """Return the fewest keys, from the first on, that together hold 95 % of the probability."""
    held = np.cumsum(list(chances.values())) / sum(chances.values())
    return tuple(chances)[: int((held < CREDIBLE).sum()) + 1]
