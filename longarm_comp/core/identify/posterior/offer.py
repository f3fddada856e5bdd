"""Offers: what a single effect may be; and the single effect that is chosen among them."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

ROUNDING = 1e-6
"""Difference of probabilities, or of log evidence, that tells nothing: names of the same columns
differ by it, and on each machine otherwise."""

UNLIKELY = 0.01
"""Probability, or change of one, that counts for nothing."""


@dataclass(frozen=True)
class Offer:
    """One thing that a single effect may be.

    Attributes:
        name: its name; offers of one name share that name's probability.
        keys: the places that it would take. Only one form may be at each.
        columns: positions of its columns in the bank, by key.
        log_prior: its log probability, given that there is an effect.
        sizes: prior standard deviations of its coefficients, in units of the columns.
        chances: log probability of each size.
        fixed: whether its coefficients are 1, so that it is there as a whole or not at all.
        site: where a cause without a name acts. All functions at one site are one cause.
    """

    name: str
    keys: tuple[Hashable, ...]
    columns: tuple[tuple[int, ...], ...]
    log_prior: float
    sizes: tuple[float, ...] = (1.0,)
    chances: tuple[float, ...] = (0.0,)
    fixed: bool = False
    site: str = ""

    @property
    def column_numbers(self) -> tuple[int, ...]:
        """The numbers of all its columns."""
        return tuple(k for own in self.columns for k in own)

    def beside(self, held: frozenset[Hashable]) -> Offer | None:
        """Return the offer without the places that others hold; None where less than two are left.

        One place of several is an offer of its own already.
        """
        left = sum(key not in held for key in self.keys)
        if left == len(self.keys):
            return self
        return None if left < 2 else self.without(held)

    def without(self, held: Container[Hashable]) -> Offer:
        """Return the offer at its other places."""
        left = [(k, c) for k, c in zip(self.keys, self.columns, strict=True) if k not in held]
        keys, columns = zip(*left, strict=True)
        return dataclasses.replace(self, keys=keys, columns=columns)


@dataclass(frozen=True)
class OtherEffects:
    """The other effects, as far as they limit what one effect may choose.

    Attributes:
        shut: offers that are excluded.
        held: places that other effects hold.
        names: names of other effects.
        sites: sites of the others that are functions without a name.
    """

    shut: frozenset[int] = frozenset()
    held: frozenset[Hashable] = frozenset()
    names: frozenset[str] = frozenset()
    sites: frozenset[str] = frozenset()

    @classmethod
    def of(cls, effects: Sequence[SingleEffect], shut: frozenset[int]) -> OtherEffects:
        """Summarise some other effects; names and sites are those of the probable ones."""
        there = [e for e in effects if e.presence > 0.5]
        return cls(
            shut,
            frozenset(key for e in effects for key in e.held_places),
            frozenset(e.offer.name for e in there),
            frozenset(e.offer.site for e in there if e.offer.site),
        )


@dataclass(frozen=True, eq=False)
class SingleEffect:
    """One effect of the sum.

    Attributes:
        offered: the C offers of the bank.
        q: (C,) probability of every offer; what is missing to 1 is that of no effect.
        mean: (K,) mean coefficients of the bank's columns.
        changed: offers that lost places to other effects, by their number.
    """

    offered: Sequence[Offer]
    q: np.ndarray
    mean: np.ndarray
    changed: dict[int, Offer] = field(default_factory=dict)

    @cached_property
    def presence(self) -> float:
        """Probability that it is there at all."""
        return min(float(self.q.sum()), 1.0)

    @cached_property
    def best(self) -> int:
        """The most probable offer: the first of those that only rounding distinguishes."""
        return int(np.argmax(self.q >= (1.0 - ROUNDING) * self.q.max()))

    @property
    def offer(self) -> Offer:
        """The most probable offer, without the places that other effects hold."""
        return self._offer_of(self.best)

    @cached_property
    def held_places(self) -> frozenset[Hashable]:
        """Places that it takes with a probability above 0.5."""
        chance: dict[Hashable, float] = {}
        for number in np.flatnonzero(self.q > UNLIKELY).tolist():
            for key in self._offer_of(number).keys:
                chance[key] = chance.get(key, 0.0) + float(self.q[number])
        return frozenset(key for key, p in chance.items() if p > 0.5)

    def _offer_of(self, number: int) -> Offer:
        return self.changed.get(number, self.offered[number])
