"""What the posterior says: single effects with their credible sets, and functions on offer."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.identify.candidates import Candidate, Term

CREDIBLE = 0.95
"""Probability that a credible set holds."""


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
        where: (places, probability) likewise, of the most probable name.
        log_bayes_factor: of it on top of the others.
        rivals: the best candidate of every other name in the credible set, with its log Bayes
            factor in the place of this effect.
    """

    terms: tuple[Term, ...]
    there: float
    names: tuple[tuple[str, float], ...]
    where: tuple[tuple[tuple[str, ...], float], ...]
    log_bayes_factor: float
    rivals: tuple[tuple[Candidate, float], ...] = ()

    @property
    def name(self) -> str:
        """The most probable name."""
        return self.terms[0].name

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

    @property
    def credible(self) -> tuple[str, ...]:
        """The smallest set of names that holds 95 % of the probability."""
        made, total = [], 0.0
        for name, chance in self.names:
            made.append(name)
            total += chance
            if total >= CREDIBLE:
                break
        return tuple(made)


@dataclass(frozen=True)
class Explained:
    """The posterior's answer.

    Attributes:
        found: single effects that are there with a probability of 95 %.
        doubtful: others that are more likely there than not.
        evidence: of the best explanation.
    """

    found: tuple[FoundEffect, ...]
    doubtful: tuple[FoundEffect, ...]
    evidence: float
