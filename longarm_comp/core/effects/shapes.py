"""Functions of a discovered effect, as text: products of shapes, each of one quantity.

A function is ``1`` or up to three factors joined by `` * ``; each factor is a shape of a quantity,
as in ``linear(q2) * switch(load_3, 1.2, 0.05)``.  A domain, ``q2 -0.4..0.7; load_3 -2.1..1.8``,
gives the range of each quantity in the data; outside its range a quantity counts as at the end.
Both texts are parsed as data and never executed as code.
"""

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
"""Highest order of a polynomial; a higher one would fit the noise of a few hundred poses."""
LARGEST = 1e9
"""Largest number that a function or a domain may hold."""


class FunctionError(ValueError):
    """A text is not a valid function or domain: `value` is wrong, `allowed` is allowed instead."""

    def __init__(self, value: object, allowed: str) -> None:
        super().__init__(f"{value}: {allowed}")
        self.value, self.allowed = value, allowed


@dataclass(frozen=True)
class Shape(ABC):
    """A function of one quantity."""

    word: ClassVar[str]  # its name in a text
    power = 0  # the unit of a value is that of the quantity to this power
    written = "{of}"  # format string of the formula

    of: str  # name of the quantity
    low: float  # range of the quantity in the data
    high: float

    @property
    def quantity(self) -> Quantity:
        found = quantity(self.of)
        assert found is not None, "checked when the text was read"
        return found

    def at(self, x: Scalar) -> Scalar:
        """Return the value at x, which is first limited to the range."""
        return self.value(spatial.minimum(spatial.maximum(x, self.low), self.high))

    @abstractmethod
    def value(self, x: Scalar) -> Scalar:
        """Return the value at x, which lies within the range."""

    def change_beyond(self, x: np.ndarray) -> np.ndarray:
        """Estimate the possible change of the value from the end of the range to x outside it.

        It is the variation of the value over the range, times the distance of x from the range over
        the length of the range; 0 inside.
        """
        varies = np.ptp(self.value(np.linspace(self.low, self.high, 33)))
        beyond = np.maximum(np.maximum(self.low - x, x - self.high), 0.0)
        return np.asarray(varies * beyond / (self.high - self.low))

    @property
    def formula(self) -> str:
        """The formula for people, with the values of its numbers."""
        return self.written.format(**vars(self))

    @property
    def text(self) -> str:
        numbers = "".join(f", {float(getattr(self, name))!r}" for name in self.numbers())
        return f"{self.word}({self.of}{numbers})"

    @classmethod
    def numbers(cls) -> tuple[str, ...]:
        """Return the names of the shape's own numbers, in the order of the text."""
        of_all = {f.name for f in dataclasses.fields(Shape)}
        return tuple(f.name for f in dataclasses.fields(cls) if f.name not in of_all)

    def check(self) -> None:
        """Raise `FunctionError` if a number is out of its bounds."""
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
    """Legendre polynomial of the quantity, scaled to -1..1 over its range."""

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
"""Largest phase of a wave over its range, rad: 160 periods are more than poses can show."""


@dataclass(frozen=True)
class Wave(Shape):
    """A harmonic of the quantity, with `order` periods in 2 pi."""

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
    """A shape that changes its behaviour at one value of the quantity, the threshold."""

    threshold: float = 0.0


@dataclass(frozen=True)
class Switch(Threshold):
    """-1 below the threshold and +1 above it, with a ramp within +-`half` of it."""

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
    """The quantity less the threshold where this is positive, else 0: a contact, a taut cable."""

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
"""Shapes by their names in a model file."""


_MOST_FACTORS = 3
"""Largest number of factors; a few hundred poses cannot distinguish more of them from noise."""


@dataclass(frozen=True)
class Function:
    """A product of shapes; 1 if there is none."""

    factors: tuple[Shape, ...] = ()

    def value(self, read: Callable[[Quantity], Scalar]) -> Scalar:
        """Compute the product of its shapes; `read` returns the value of a quantity."""
        return math.prod((f.at(read(f.quantity)) for f in self.factors), start=1.0)

    def change_beyond(self, read: Callable[[Quantity], Scalar]) -> np.ndarray:
        """Estimate the possible error of `value` outside the ranges, to first order."""
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
        """The text of the ranges of its quantities, as it is stored."""
        held = {f.of: f"{f.of} {f.low!r}..{f.high!r}" for f in self.factors}
        return "; ".join(held.values())

    @property
    def formula(self) -> str:
        """The formula for people, a product of its factors; empty for the constant 1."""
        return " x ".join(f.formula for f in self.factors)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The quantities on which the function depends, each once."""
        return tuple(dict.fromkeys(f.quantity for f in self.factors))

    def units(self, arm: Arm) -> list[str]:
        """Return the units whose product is the unit of the value; empty for a plain number."""
        each = ([factor.quantity.unit(arm)] * factor.power for factor in self.factors)
        return [unit for units in each for unit in units if unit != "1"]


_FACTOR = re.compile(r"([a-z_]+)\(([A-Za-z]\w*)((?:, [^,()]+)*)\)")
_RANGE = re.compile(r"([A-Za-z]\w*) (\S+?)\.\.(\S+)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@lru_cache(maxsize=4096)
def function(text: str, domain: str) -> Function:
    """Return the function that a text and the text of its domain describe.

    Raises:
        FunctionError: a part is not a shape, quantity, number or range; there are too many
            factors; a quantity has no range, or a range no quantity.
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
