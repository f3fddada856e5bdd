"""Shapes: functions of one quantity, of which the functions of a discovered effect are products.

Outside the range of the data a quantity counts as at the end of its range.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.quantities import Quantity, quantity

_MOST_ORDER = 8
"""Of a polynomial: one of a higher order is a function of its noise at a few hundred poses."""
LARGEST = 1e9
"""Largest number that a function or a domain may hold."""


class FunctionError(ValueError):
    """A text is no function or no domain: `value` is wrong, `allowed` what it may be."""

    def __init__(self, value: object, allowed: str) -> None:
        super().__init__(f"{value}: {allowed}")
        self.value, self.allowed = value, allowed


@dataclass(frozen=True)
class Shape(ABC):
    """A function of one quantity.

    Attributes:
        power: of the quantity's unit, that a value has.
        written: the formula, with its fields.
        of: name of the quantity.
        low, high: its range in the data.
    """

    word: ClassVar[str]
    power = 0
    written = "{of}"

    of: str
    low: float
    high: float

    @property
    def quantity(self) -> Quantity:
        found = quantity(self.of)
        assert found is not None, "checked when the text was read"
        return found

    def at(self, x: Scalar) -> Scalar:
        """Value where the quantity is x, kept within its range."""
        return self.value(spatial.minimum(spatial.maximum(x, self.low), self.high))

    @abstractmethod
    def value(self, x: Scalar) -> Scalar:
        """Value at x within the range."""

    @property
    def formula(self) -> str:
        """For people."""
        return self.written.format(**vars(self))

    @property
    def text(self) -> str:
        numbers = "".join(f", {float(getattr(self, name))!r}" for name in self.numbers())
        return f"{self.word}({self.of}{numbers})"

    @classmethod
    def numbers(cls) -> tuple[str, ...]:
        """Names of its own numbers, in the order of the text."""
        return tuple(f.name for f in dataclasses.fields(cls) if f.name not in _COMMON)

    def check(self) -> None:
        """Raise `FunctionError` where a number is out of its bounds."""
        for name in self.numbers():
            number = getattr(self, name)
            if not abs(number) <= LARGEST:
                raise FunctionError(f"{self.word}: {name} {number}", f"within +-{LARGEST:g}")


_COMMON = ("of", "low", "high")


class Linear(Shape):
    """x."""

    word = "linear"
    power = 1

    def value(self, x: Scalar) -> Scalar:
        return x


class Square(Shape):
    """x^2."""

    word = "square"
    written = "{of}^2"
    power = 2

    def value(self, x: Scalar) -> Scalar:
        return x * x


class SignedSquare(Shape):
    """x |x|."""

    word = "signed_square"
    written = "{of} |{of}|"
    power = 2

    def value(self, x: Scalar) -> Scalar:
        return x * spatial.absolute(x)


@dataclass(frozen=True)
class Legendre(Shape):
    """Legendre polynomial over the range."""

    word = "legendre"
    written = "P{order:g}({of})"

    order: float = 1.0

    def value(self, x: Scalar) -> Scalar:
        u = (x - 0.5 * (self.low + self.high)) * (2.0 / (self.high - self.low))
        before, now = 1.0, u
        for n in range(1, int(self.order)):
            before, now = now, ((2 * n + 1.0) * u * now - float(n) * before) * (1.0 / (n + 1))
        return now

    def check(self) -> None:
        if self.order not in range(1, _MOST_ORDER + 1):
            raise FunctionError(f"{self.word}: order {self.order:g}", f"1, 2, ..., {_MOST_ORDER}")


_MOST_TURN = 1000.0
"""Phase of a wave over its range at most, rad: 160 periods are more than poses can show."""


@dataclass(frozen=True)
class Wave(Shape):
    """A harmonic of the quantity itself: so many periods in 2 pi."""

    order: float = 1.0

    def check(self) -> None:
        if not 0 < self.order * (self.high - self.low) <= _MOST_TURN:
            allowed = f"above 0, at most {_MOST_TURN:g} rad over the range of {self.of}"
            raise FunctionError(f"{self.word}: order {self.order:g}", allowed)

    @property
    def formula(self) -> str:
        return f"{self.word}({'' if self.order == 1 else f'{self.order:g} '}{self.of})"


class Cosine(Wave):
    """cos(order x)."""

    word = "cos"

    def value(self, x: Scalar) -> Scalar:
        return spatial.cos(self.order * x)


class Sine(Wave):
    """sin(order x)."""

    word = "sin"

    def value(self, x: Scalar) -> Scalar:
        return spatial.sin(self.order * x)


@dataclass(frozen=True)
class Threshold(Shape):
    """Something that happens at one value of the quantity."""

    threshold: float = 0.0


@dataclass(frozen=True)
class Switch(Threshold):
    """-1 below the threshold, +1 above it, a ramp within `half` of it."""

    word = "switch"
    written = "sign({of} - {threshold:.4g})"

    half: float = 1.0

    def value(self, x: Scalar) -> Scalar:
        ramp = (x - self.threshold) * (1.0 / self.half)
        return spatial.minimum(spatial.maximum(ramp, -1.0), 1.0)

    def check(self) -> None:
        super().check()
        if not self.half > 1e-9:
            raise FunctionError(f"{self.word}: half {self.half}", "above 1e-9")


class Above(Threshold):
    """How far the quantity is above the threshold, else 0: a contact, a taut cable."""

    word = "above"
    written = "max(0, {of} - {threshold:.4g})"
    power = 1

    def value(self, x: Scalar) -> Scalar:
        return spatial.maximum(x - self.threshold, 0.0)


class Below(Threshold):
    """How far the quantity is below the threshold, else 0."""

    word = "below"
    written = "max(0, {threshold:.4g} - {of})"
    power = 1

    def value(self, x: Scalar) -> Scalar:
        return spatial.maximum(self.threshold - x, 0.0)


SHAPES: dict[str, type[Shape]] = {
    kind.word: kind
    for kind in (Linear, Square, SignedSquare, Legendre, Cosine, Sine, Switch, Above, Below)
}
"""Shapes by the word that stands for them in a model file."""
