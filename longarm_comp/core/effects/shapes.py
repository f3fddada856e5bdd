"""Functions of a discovered effect: products of shapes, each a function of one quantity, as text.

A function is ``1`` or up to three factors joined by `` * ``; each is a shape of a quantity, as in
``linear(q2) * switch(load_3, 1.2, 0.05)``.  A domain, ``q2 -0.4..0.7; load_3 -2.1..1.8``, gives the
range of each quantity in the data; outside it a quantity counts as at the end.  Both are data:
nothing is evaluated as code.
"""

from __future__ import annotations

import dataclasses
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.quantities import Quantity, quantity

_MOST_ORDER = 8
"""Of a polynomial: one of a higher order is a function of its noise at a few hundred poses."""
LARGEST = 1e9
"""Largest number that a function or a domain may hold."""
_LOOKS = 33
"""Places over its range at which a shape is looked at."""


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
        """Return the value where the quantity is x, which is kept within its range."""
        return self.value(spatial.minimum(spatial.maximum(x, self.low), self.high))

    @abstractmethod
    def value(self, x: Scalar) -> Scalar:
        """Return the value at x, which lies within the range."""

    def change_beyond(self, x: np.ndarray) -> np.ndarray:
        """Estimate how far the value may be from that at the end of the range, at x outside it.

        It may go on as it varies within: by its whole variation over the range, for as far again.
        """
        varies = np.ptp(self.value(np.linspace(self.low, self.high, _LOOKS)))
        beyond = np.maximum(np.maximum(self.low - x, x - self.high), 0.0)
        return np.asarray(varies * beyond / (self.high - self.low))

    @property
    def formula(self) -> str:
        """The formula for a reader, with the numbers of its fields."""
        return self.written.format(**vars(self))

    @property
    def text(self) -> str:
        numbers = "".join(f", {float(getattr(self, name))!r}" for name in self.numbers())
        return f"{self.word}({self.of}{numbers})"

    @classmethod
    def numbers(cls) -> tuple[str, ...]:
        """Return the names of its own numbers, in the order of the text."""
        of_all = {f.name for f in dataclasses.fields(Shape)}
        return tuple(f.name for f in dataclasses.fields(cls) if f.name not in of_all)

    def check(self) -> None:
        """Raise `FunctionError` where a number is out of its bounds."""
        for name in self.numbers():
            number = getattr(self, name)
            if not abs(number) <= LARGEST:
                raise FunctionError(f"{self.word}: {name} {number}", f"within +-{LARGEST:g}")


class Linear(Shape):
    word = "linear"
    power = 1

    def value(self, x: Scalar) -> Scalar:
        return x


class Square(Shape):
    word = "square"
    written = "{of}^2"
    power = 2

    def value(self, x: Scalar) -> Scalar:
        return x * x


class SignedSquare(Shape):
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
    word = "cos"

    def value(self, x: Scalar) -> Scalar:
        return spatial.cos(self.order * x)


class Sine(Wave):
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
    """The excess of the quantity above the threshold, else 0: a contact, a taut cable."""

    word = "above"
    written = "max(0, {of} - {threshold:.4g})"
    power = 1

    def value(self, x: Scalar) -> Scalar:
        return spatial.maximum(x - self.threshold, 0.0)


class Below(Threshold):
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


_MOST_FACTORS = 3
"""Of a product: more than a few hundred poses tell apart from noise."""


@dataclass(frozen=True)
class Function:
    """A product of shapes; 1 without any."""

    factors: tuple[Shape, ...] = ()

    def value(self, read: Callable[[Quantity], Scalar]) -> Scalar:
        """Compute the product of its shapes, given a function that reads a quantity."""
        return math.prod((f.at(read(f.quantity)) for f in self.factors), start=1.0)

    def change_beyond(self, read: Callable[[Quantity], Scalar]) -> np.ndarray:
        """Estimate how far it may be from what `value` is, outside the ranges, to first order."""
        values = [factor.at(read(factor.quantity)) for factor in self.factors]
        changes = [
            f.change_beyond(np.asarray(read(f.quantity))) * math.prod(values[:k] + values[k + 1 :])
            for k, f in enumerate(self.factors)
        ]
        return np.asarray(np.sqrt(sum((change**2 for change in changes), start=np.zeros(1))))

    @property
    def text(self) -> str:
        return " * ".join(f.text for f in self.factors) or "1"

    @property
    def domain(self) -> str:
        """Ranges of its quantities, as they are stored."""
        held = {f.of: f"{f.of} {f.low!r}..{f.high!r}" for f in self.factors}
        return "; ".join(held.values())

    @property
    def formula(self) -> str:
        """The formula for a reader, a product of its factors; empty for the constant."""
        return " x ".join(f.formula for f in self.factors)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The quantities that it depends on."""
        return tuple(dict.fromkeys(f.quantity for f in self.factors))

    def units(self, arm: Arm) -> list[str]:
        """Return the units of its factors, whose product is the unit of its value; empty for a
        number."""
        each = ([factor.quantity.unit(arm)] * factor.power for factor in self.factors)
        return [unit for units in each for unit in units if unit != "1"]


_FACTOR = re.compile(r"([a-z_]+)\(([A-Za-z]\w*)((?:, [^,()]+)*)\)")
_RANGE = re.compile(r"([A-Za-z]\w*) (\S+?)\.\.(\S+)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@lru_cache(maxsize=4096)
def function(text: str, domain: str) -> Function:
    """Return the function of a text over a domain.

    Raises:
        FunctionError: a part that is no shape, quantity, number or range; too many factors; a
            quantity without its range, or a range without its quantity.
    """
    ranges = _parse_domain(domain)
    parts = [] if text == "1" else text.split(" * ")
    if len(parts) > _MOST_FACTORS:
        raise FunctionError(f"{len(parts)} factors", f"at most {_MOST_FACTORS}")
    factors = tuple(_parse_factor(part, ranges) for part in parts)
    for name in ranges:
        if all(f.of != name for f in factors):
            raise FunctionError(f"domain of {name}", "quantities of the function only")
    return Function(factors)


def _parse_factor(text: str, ranges: dict[str, tuple[float, float]]) -> Shape:
    found = _FACTOR.fullmatch(text)
    kind = SHAPES.get(found.group(1)) if found else None
    if found is None or kind is None:
        allowed = f"a shape of a quantity, as linear(q2); shapes: {', '.join(SHAPES)}"
        raise FunctionError(text, allowed)
    name, listed = found.group(2), found.group(3).split(", ")[1:]
    if name not in ranges:
        raise FunctionError(f"domain without {name}", f"its range, as {name} -1.0..1.0")
    if len(listed) != len(kind.numbers()):
        allowed = ", ".join(("quantity", *kind.numbers()))
        raise FunctionError(text, f"{kind.word}({allowed})")
    made = kind(name, *ranges[name], *map(_parse_number, listed))
    made.check()
    return made


def _parse_domain(domain: str) -> dict[str, tuple[float, float]]:
    made: dict[str, tuple[float, float]] = {}
    for part in domain.split("; ") if domain else ():
        found = _RANGE.fullmatch(part)
        if found is None or quantity(found.group(1)) is None:
            raise FunctionError(part, "a quantity and its range, as q2 -0.4..0.7")
        low, high = _parse_number(found.group(2)), _parse_number(found.group(3))
        if not (low < high and max(abs(low), abs(high)) <= LARGEST):
            raise FunctionError(part, f"lower..upper with lower < upper, within +-{LARGEST:g}")
        if found.group(1) in made:
            raise FunctionError(part, "each quantity once")
        made[found.group(1)] = (low, high)
    return made


def _parse_number(text: str) -> float:
    if not _NUMBER.fullmatch(text):
        raise FunctionError(text, "a number")
    return float(text)
