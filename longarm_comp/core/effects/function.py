"""Functions of a discovered effect: products of shapes, written as text.

A function is ``1`` or up to three factors joined by `` * ``; each is a shape of a quantity, as in
``linear(q2) * switch(load_3, 1.2, 0.05)``.  A domain, ``q2 -0.4..0.7; load_3 -2.1..1.8``, gives the
range of each quantity in the data.  Both are data: nothing is evaluated as code.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.quantities import Quantity, quantity
from longarm_comp.core.effects.shapes import LARGEST, SHAPES, FunctionError, Shape

_MOST_FACTORS = 3
"""Of a product: more than a few hundred poses tell apart from noise."""

_Read = Callable[[Quantity], Scalar]


@dataclass(frozen=True)
class Function:
    """A product of shapes; 1 without any."""

    factors: tuple[Shape, ...] = ()

    def value(self, read: _Read) -> Scalar:
        """Its value, given how to read a quantity."""
        product: Scalar = 1.0
        for factor in self.factors:
            product = product * factor.at(read(factor.quantity))
        return product

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
        """For people; empty for the constant."""
        return " x ".join(f.formula for f in self.factors)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What it depends on."""
        return tuple(dict.fromkeys(f.quantity for f in self.factors))

    def units(self, arm: Arm) -> list[str]:
        """Units of its value, to be multiplied; empty for a number."""
        made = []
        for factor in self.factors:
            unit = factor.quantity.unit(arm)
            made += [unit] * factor.power if unit != "1" else []
        return made


_FACTOR = re.compile(r"([a-z_]+)\(([A-Za-z]\w*)((?:, [^,()]+)*)\)")
_RANGE = re.compile(r"([A-Za-z]\w*) (\S+?)\.\.(\S+)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@lru_cache(maxsize=4096)
def function(text: str, domain: str) -> Function:
    """The function of a text over a domain.

    Raises:
        FunctionError: a part that is no shape, quantity, number or range; too many factors; a
            quantity without its range, or a range without its quantity.
    """
    ranges = _ranges(domain)
    parts = [] if text == "1" else text.split(" * ")
    if len(parts) > _MOST_FACTORS:
        raise FunctionError(f"{len(parts)} factors", f"at most {_MOST_FACTORS}")
    factors = tuple(_factor(part, ranges) for part in parts)
    for name in ranges:
        if all(f.of != name for f in factors):
            raise FunctionError(f"domain of {name}", "quantities of the function only")
    return Function(factors)


def _factor(text: str, ranges: dict[str, tuple[float, float]]) -> Shape:
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
    made = kind(name, *ranges[name], *map(_number, listed))
    made.check()
    return made


def _ranges(domain: str) -> dict[str, tuple[float, float]]:
    made: dict[str, tuple[float, float]] = {}
    for part in domain.split("; ") if domain else ():
        found = _RANGE.fullmatch(part)
        if found is None or quantity(found.group(1)) is None:
            raise FunctionError(part, "a quantity and its range, as q2 -0.4..0.7")
        low, high = _number(found.group(2)), _number(found.group(3))
        if not (low < high and max(abs(low), abs(high)) <= LARGEST):
            raise FunctionError(part, f"lower..upper with lower < upper, within +-{LARGEST:g}")
        if found.group(1) in made:
            raise FunctionError(part, "each quantity once")
        made[found.group(1)] = (low, high)
    return made


def _number(text: str) -> float:
    if not _NUMBER.fullmatch(text):
        raise FunctionError(text, "a number")
    if not math.isfinite(float(text)):
        raise FunctionError(text, "a finite number")
    return float(text)
