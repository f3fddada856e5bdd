"""Offers: the choices for a single effect; and the single effect, with a probability of each."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

ROUNDS = 16
"""Largest number of repetitions of every loop of the search. Each ends by itself, after three to
ten; half of it or twice found the same names at the same places."""
UNLIKELY = 0.01
"""Probability, or change of a probability, that is ignored: findings are sure to 5 %."""
ROUNDING = float(np.finfo(np.float32).eps)
"""Relative difference of probabilities that may be rounding alone, half of the digits. Names with
the same columns may differ by it, and differently on each machine."""


@dataclass(frozen=True)
class Offer:
    """One choice for a single effect: a name, its places and its form.

    Attributes:
        name: name of the effect; the offers of one name share that name's probability.
        keys: the places at which it acts. Each place can hold one form only.
        columns: positions of its columns in the bank, by key.
        log_prior: its log probability, given that there is an effect.
        sizes: possible prior standard deviations of its coefficients, in units of the columns.
        chances: log probability of each size.
        fixed: whether its coefficients are always 1: it is there as a whole or not at all.
        site: where a cause without a name acts; "" for a named effect. All functions at one site
            are one cause.
    """

    name: str
    keys: tuple[Hashable, ...]
    columns: tuple[tuple[int, ...], ...]
    log_prior: float
    sizes: tuple[float, ...] = (1.0,)
    chances: tuple[float, ...] = (0.0,)
    fixed: bool = False
    site: str = ""

    @cached_property
    def column_numbers(self) -> tuple[int, ...]:
        """The numbers of all its columns."""
        return tuple(k for own in self.columns for k in own)

    def free_part(self, held: frozenset[Hashable]) -> Offer | None:
        """Return the offer without the places in `held`; None if fewer than two of them are left.

        An offer that loses no place is returned unchanged. A single place of several is an offer of
        its own in the bank.
        """
        left = len(self.keys) - len(held.intersection(self.keys))
        if left == len(self.keys):
            return self
        return None if left < 2 else self.without(held)

    def without(self, held: Container[Hashable]) -> Offer:
        """Return the offer without the places in `held`."""
        left = [(k, c) for k, c in zip(self.keys, self.columns, strict=True) if k not in held]
        keys, columns = zip(*left, strict=True)
        return dataclasses.replace(self, keys=keys, columns=columns)


@dataclass(frozen=True)
class OtherEffects:
    """The limits that the other effects of an explanation set to one effect.

    Attributes:
        excluded: numbers of the offers that are excluded.
        held: places that other effects take.
        names: names of other effects.
        sites: sites of the other effects that are functions without a name.
    """

    excluded: frozenset[int] = frozenset()
    held: frozenset[Hashable] = frozenset()
    names: frozenset[str] = frozenset()
    sites: frozenset[str] = frozenset()

    @classmethod
    def of(cls, effects: Sequence[SingleEffect], excluded: frozenset[int]) -> OtherEffects:
        """Summarise other effects; names and sites are those of effects that are probably there."""
        there = [e for e in effects if e.presence > 0.5]
        return cls(
            excluded,
            frozenset(key for e in effects for key in e.held_places),
            frozenset(e.offer.name for e in there),
            frozenset(e.offer.site for e in there if e.offer.site),
        )


@dataclass(frozen=True, eq=False)
class SingleEffect:
    """One effect of an explanation, with the probability of every offer.

    Attributes:
        offered: the C offers of the bank.
        probabilities: (C,) of the offers; no effect has 1 less their sum.
        mean: (K,) mean coefficients of the bank's columns.
        changed: what is left of offers that lost places to other effects, by offer number.
    """

    offered: Sequence[Offer]
    probabilities: np.ndarray
    mean: np.ndarray
    changed: dict[int, Offer] = field(default_factory=dict)

    @cached_property
    def presence(self) -> float:
        """Probability that it is there at all."""
        return min(float(self.probabilities.sum()), 1.0)

    @cached_property
    def best(self) -> int:
        """The number of the most probable offer; of equals, within rounding, the first."""
        return int(np.argmax(self.probabilities >= (1.0 - ROUNDING) * self.probabilities.max()))

    @cached_property
    def offer(self) -> Offer:
        """The most probable offer, without the places that other effects take."""
        return self._offer_of(self.best)

    @cached_property
    def held_places(self) -> frozenset[Hashable]:
        """Places that it takes with a probability above 0.5."""
        chance: dict[Hashable, float] = {}
        for number in np.flatnonzero(self.probabilities > UNLIKELY).tolist():
            for key in self._offer_of(number).keys:
                chance[key] = chance.get(key, 0.0) + float(self.probabilities[number])
        return frozenset(key for key, p in chance.items() if p > 0.5)

    def _offer_of(self, number: int) -> Offer:
        return self.changed.get(number, self.offered[number])
