"""What a single effect may be, and what it is found to be."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Hashable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Offer:
    """One thing that a single effect may be.

    Attributes:
        name: what it is called; offers of one name share a name's probability.
        keys: the places that it would take. One form only may be at each.
        columns: positions of its columns in the bank, by key.
        log_prior: log probability of it, given that there is an effect.
        sizes: prior standard deviations of its coefficients, in units of the columns.
        chances: log probability of each size.
        fixed: whether its coefficients are 1: it is there, whole, or it is not.
        site: where a cause without a name acts. Whatever is there of it is one cause.
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
    def places(self) -> tuple[int, ...]:
        """All of its columns."""
        return tuple(k for own in self.columns for k in own)

    def beside(self, held: frozenset[Hashable]) -> Offer | None:
        """What is left of it where others hold some of its places; None where that is nothing.

        One place of several is an offer of its own already.
        """
        left = sum(key not in held for key in self.keys)
        if left == len(self.keys):
            return self
        return None if left < 2 else self.without(held)

    def without(self, held: Container[Hashable]) -> Offer:
        """It at its other places."""
        left = [(k, c) for k, c in zip(self.keys, self.columns, strict=True) if k not in held]
        keys, columns = zip(*left, strict=True)
        return dataclasses.replace(self, keys=keys, columns=columns)


@dataclass(frozen=True)
class SingleEffect:
    """One effect of the sum.

    Attributes:
        q: (C,) probability of every offer of the bank; what is missing to 1 is none.
        mean: (K,) coefficients of the bank's columns on average.
        offers: what offers became beside the places that other effects hold.
    """

    q: np.ndarray
    mean: np.ndarray
    offers: dict[int, Offer] = field(default_factory=dict)

    @cached_property
    def there(self) -> float:
        """Probability that it is there at all."""
        return min(float(self.q.sum()), 1.0)

    @cached_property
    def best(self) -> int:
        """The most probable offer."""
        return int(np.argmax(self.q))
