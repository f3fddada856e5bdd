"""The functions that are tried: shapes of one input and products of two, in groups."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import combinations

import numpy as np

from longarm_comp.core.effects.quantities import Quantity
from longarm_comp.core.effects.shapes import (
    Above,
    Below,
    Cosine,
    Function,
    Legendre,
    Linear,
    Shape,
    SignedSquare,
    Sine,
    Square,
    Switch,
    Threshold,
    Wave,
)
from longarm_comp.core.identify.discover.inputs import (
    FINE_GRID,
    GRID,
    FunctionInput,
    FunctionInputs,
)

ANALYTIC = 0.25
"""Factor by which the Legendre coefficients of a physical function of one joint fall from one order
to the next: about that of cos q over two radians. (Over four radians it is a half.)"""
ORDERS = 5
"""Highest Legendre order of a smooth function of one input, which turns at most four times; faster
ones are waves."""
TOTAL = 3
"""Highest sum of the Legendre orders of a smooth function of two inputs: nine coefficients."""
REFINED = 4
"""Number of the best candidates of a rough search that are searched finely: the log prior of a
refined function includes the choice among these."""


class FunctionFamily(Enum):
    """The kinds of functions; all have the same prior probability."""

    CONSTANT = "constant"
    LINEAR = "linear"
    SQUARE = "square"
    PRODUCT = "product"
    WAVE = "harmonic"
    SMOOTH = "smooth"
    SMOOTH_PAIR = "smooth in two"
    SWITCH = "switch"
    CONTACT = "contact"
    EACH_JOINT = "the same at each joint"
    OWN_JOINT = "smooth in a joint, along its axis"


OWN = ("q", "load_", "side_")
"""Names, without the joint's number, of the inputs that each joint has of its own."""


@dataclass(frozen=True)
class FunctionGroup:
    """Functions that are fitted together, each with its own coefficient.

    Attributes:
        family: their kind.
        functions: numbers of the functions.
        decay: prior standard deviation of each, relative to the first.
        rare: number of their quantities on which a cause seldom depends. Each lowers the log prior
            by `NONE`.
    """

    family: FunctionFamily
    functions: tuple[int, ...]
    decay: tuple[float, ...]
    rare: int = 0


class Functions:
    """Every function that is tried, with its values at N rows.

    Args:
        inputs: the quantities that functions may depend on.
        of: class of quantity that each function must depend on; None: any.

    Attributes:
        groups: the groups of functions that are fitted together at one component.
        each_joint: sets of (commanded joint, function) that are fitted together, each function
            along its joint's own axis.
        own_joint: by commanded joint, the smooth functions of its position that move it along its
            own axis, as a hose, a spring or a gear may.
    """

    def __init__(self, inputs: FunctionInputs, of: type[Quantity] | None = None) -> None:
        self.inputs, self._of = inputs, of
        self.listed: list[Function] = []
        self.groups: list[FunctionGroup] = []
        self.each_joint: list[tuple[tuple[int, int], ...]] = []
        self.own_joint: dict[int, FunctionGroup] = {}
        self._values: list[np.ndarray] = []
        self._shapes: dict[Shape, np.ndarray] = {}
        self._numbers: dict[Function, int] = {}
        self._add_every_family()

    @cached_property
    def counts(self) -> Counter[FunctionFamily]:
        """Number of groups of each family."""
        return Counter(group.family for group in self.groups)

    @cached_property
    def values(self) -> np.ndarray:
        """(N, G) values of all functions."""
        return np.stack(self._values, axis=1)

    def _add_function(self, factors: tuple[Shape, ...]) -> int:
        """Return the number in `listed` of a product of shapes, and add it if it is new."""
        made = Function(factors)
        if made not in self._numbers:
            self._numbers[made] = len(self.listed)
            self.listed.append(made)
            self._values.append(self.values_of(made))
        return self._numbers[made]

    def values_of(self, made: Function) -> np.ndarray:
        """Return the (N,) values of any function of the inputs."""
        values = np.ones(len(self.inputs.all[0].values)) if self.inputs.all else np.ones(0)
        for factor in made.factors:
            if factor not in self._shapes:
                of = self.inputs.by_name[factor.of]
                self._shapes[factor] = np.asarray(factor.at(of.values))
            values = values * self._shapes[factor]
        return values

    def _add_group(
        self, family: FunctionFamily, *products: tuple[Shape, ...], decay: Sequence[float] = ()
    ) -> None:
        """Add products of shapes that are fitted together, but none without an input `of`."""
        numbers = [self._add_function(factors) for factors in products]
        of = {n: self.listed[n].quantities for n in numbers}
        kept = dict(zip(numbers, decay or [1.0] * len(numbers), strict=True))
        if self._of is not None:
            kept = {n: d for n, d in kept.items() if any(isinstance(q, self._of) for q in of[n])}
        if kept:
            rare = sum(not q.plain for q in {q for n in kept for q in of[n]})
            self.groups.append(FunctionGroup(family, tuple(kept), tuple(kept.values()), rare))

    def _add_every_family(self) -> None:
        inputs = self.inputs.all
        own = {f"q{j + 1}": j for j in range(self.inputs.joints)}
        self._add_group(FunctionFamily.CONSTANT, ())
        for one in inputs:
            self._add_group(FunctionFamily.LINEAR, (_make_linear(one),))
        for one in inputs:
            if not one.shows_curves:
                continue
            for kind in (Square, SignedSquare):
                if (kind is Square and not one.is_far_from_zero) or one.low < 0 < one.high:
                    self._add_group(FunctionFamily.SQUARE, (kind(*one.domain),))
            for order in list_orders(one):
                waves = [(kind(*one.domain, order),) for kind in (Cosine, Sine)]
                self._add_group(FunctionFamily.WAVE, *waves)
            orders = range(1, min(ORDERS, one.levels - 2) + 1)
            if len(orders) > 1:
                curves = [(Legendre(*one.domain, n),) for n in orders]
                self._add_group(FunctionFamily.SMOOTH, *curves, decay=[1.0 / n for n in orders])
                if one.name in own:
                    self.own_joint[own[one.name]] = FunctionGroup(
                        FunctionFamily.OWN_JOINT,
                        tuple(self._add_function(curve) for curve in curves),
                        tuple(ANALYTIC ** (n - 1) for n in orders),
                    )
            for threshold in list_thresholds(one):
                self._add_group(FunctionFamily.SWITCH, (make_switch(one, threshold),))
                for side in (Above, Below):
                    self._add_group(FunctionFamily.CONTACT, (side(*one.domain, threshold),))
        for a, b in combinations(inputs, 2):
            self._add_group(FunctionFamily.PRODUCT, (_make_linear(a), _make_linear(b)))
        plain = (i for i in inputs if i.name.startswith("q") or i.name in self.inputs.shared)
        for a, b in combinations([i for i in plain if i.levels > 1], 2):
            self._add_smooth_pair(a, b)
        for name in self.inputs.shared:
            for word in OWN:
                self._add_each_joint(word, (_make_linear(self.inputs.by_name[name]),))
        self._add_each_joint("way_", ())

    def _add_each_joint(self, word: str, shared: tuple[Shape, ...]) -> None:
        """Add an input of each joint, times what the joints share, as a set with one for each."""
        numbered = (
            (j, self.inputs.by_name.get(f"{word}{j + 1}")) for j in range(self.inputs.joints)
        )
        made = [
            (j, self._add_function((_make_linear(own), *shared)))
            for j, own in numbered
            if own is not None
        ]
        if len(made) > 1:
            self.each_joint.append(tuple(made))

    def _add_smooth_pair(self, a: FunctionInput, b: FunctionInput) -> None:
        """Add a smooth function of two inputs: joint positions, or inputs that all joints share."""
        products, decay = [], []
        for i in range(TOTAL + 1):
            for j in range(TOTAL + 1 - i):
                if i + j == 0 or i >= max(a.levels - 1, 2) or j >= max(b.levels - 1, 2):
                    continue
                if (i > 1 and not a.shows_curves) or (j > 1 and not b.shows_curves):
                    continue
                factors = (Legendre(*one.domain, n) for one, n in ((a, i), (b, j)) if n)
                products.append(tuple(factors))
                decay.append(1.0 / (i + j))
        if len(products) > 3:
            self._add_group(FunctionFamily.SMOOTH_PAIR, *products, decay=decay)


def _make_linear(one: FunctionInput) -> Shape:
    """Return the input itself; about the middle of its range if that is far from zero.

    An input that no command knows is centred too. Then commands without it have no mean error.
    """
    if one.is_far_from_zero or not one.known_to_commands:
        return Legendre(*one.domain, 1)
    return Linear(*one.domain)


def make_switch(one: FunctionInput, threshold: float) -> Switch:
    """Return a switch at a threshold: a ramp over the gap of the data around the threshold."""
    below = one.values[one.values < threshold]
    above = one.values[one.values >= threshold]
    half = 0.5 * float(above.min() - below.max()) if len(below) and len(above) else 0.0
    middle = 0.5 * float(above.min() + below.max()) if len(below) and len(above) else threshold
    return Switch(*one.domain, middle, max(half, 1e-4 * (one.high - one.low)))


def list_orders(one: FunctionInput) -> list[float]:
    """Return the angular frequencies of an input's waves that are tried; none if it is smooth.

    They are whole numbers for an angle, else those of 2 to `GRID` + 1 half periods in the range.
    """
    if one.smooth:
        return []
    if one.circular:
        return [float(n) for n in range(1, (GRID + 1) // 2 + 1)]
    span = one.high - one.low
    return [n * math.pi / span for n in range(2, GRID + 2)]


def list_thresholds(one: FunctionInput) -> list[float]:
    """Return the thresholds of an input that are tried: quantiles of its values; none if smooth."""
    if one.smooth:
        return []
    shares = np.arange(1, GRID + 1) / (GRID + 1)
    return [float(v) for v in np.unique(np.quantile(one.values, shares)) if v > one.low]


def vary_shape(shape: Shape, one: FunctionInput, width: float) -> list[Shape]:
    """Return the same shape with up to `FINE_GRID` thresholds or orders around its own.

    Args:
        shape: a shape with a threshold, or a wave. For others, and for waves of an angle, nothing
            is returned.
        one: its input.
        width: how far to go on each side, in steps of the first grid.
    """
    if isinstance(shape, Threshold):
        place = float((one.values < shape.threshold).mean())
        step = 1.3 * width / (GRID + 1)
        shares = np.clip(np.linspace(place - step, place + step, FINE_GRID), 0.02, 0.98)
        made = np.unique(np.quantile(one.values, shares))
        if isinstance(shape, Switch):
            return [make_switch(one, float(v)) for v in made]
        return [type(shape)(*one.domain, float(v)) for v in made]
    if isinstance(shape, Wave) and not one.circular:
        step = width * math.pi / (one.high - one.low)
        made = np.linspace(shape.order - step, shape.order + step, FINE_GRID)
        return [type(shape)(*one.domain, float(v)) for v in made if v > 0]
    return []
