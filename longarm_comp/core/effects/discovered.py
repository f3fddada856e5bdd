"""An effect that a diagnosis found and that has no name: place, component and function as data.

One instance is one term: an amount times a function of the posture, acting as one component at
one place.  `core/identify/discover` finds them; a model holds any number.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import PER_JOINT, Context
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.effects.components import COMPONENTS, Acting, components, stations
from longarm_comp.core.effects.effect import Bias, Effect, Parameter, form, parameter, place
from longarm_comp.core.effects.function import Function, function
from longarm_comp.core.effects.joint_term import with_prior
from longarm_comp.core.effects.quantities import (
    AXES,
    OfPosture,
    Recorded,
    SeenCoordinate,
    SeenPoint,
)
from longarm_comp.core.effects.shapes import LARGEST, FunctionError
from longarm_comp.core.errors import InputError

CAMERA, DISTANCE = "camera", "distance"


def views(arm: Arm) -> list[str]:
    """Ways that what is measured may be displaced; a distance is from a declared camera."""
    return [*AXES, *([DISTANCE] if arm.camera is not None else [])]


class _OfFunction:
    """What a term owes to its function alone; `kind`: of quantities that it may depend on."""

    name: ClassVar[str]
    kind: ClassVar[type]
    at: str
    component: str
    function: str
    domain: str
    scale: float
    amount: float

    @property
    def where(self) -> str:
        return f"{self.at}, {self.component}"

    @cached_property
    def of(self) -> Function:
        """The function. Raises `FunctionError`."""
        return function(self.function, self.domain)

    @property
    def place(self) -> str:
        return f"{self.where}, {self.function}"

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for q in self.of.quantities for name in q.inputs))

    def require(self, context: Context) -> None:
        for column in self.inputs:
            if column not in PER_JOINT and not context.has(column):
                raise InputError(self.name, column, "missing", "a recorded column of the session")

    def check(self, arm: Arm, where: str) -> None:
        try:
            factors = self.of.factors
        except FunctionError as error:
            field = f"{self.name}.function"
            raise InputError(where, field, error.value, error.allowed) from error
        for factor in factors:
            of = factor.quantity
            if not (isinstance(of, (self.kind, Recorded)) and of.exists(arm)):
                allowed = "a quantity of this arm, or a recorded column"
                raise InputError(where, f"{self.name}.function", factor.of, allowed)
        for field, value in (("scale", self.scale), ("amount", self.amount)):
            if not (np.isfinite(value) and abs(value) <= LARGEST):
                allowed = f"a number within +-{LARGEST:g}"
                raise InputError(where, f"{self.name}.{field}", value, allowed)
        if not self.scale > 0:
            raise InputError(where, f"{self.name}.scale", self.scale, "above 0")


@dataclass(frozen=True)
class Discovered(_OfFunction, Effect):
    """A cause without a name: an amount of a twist or load, as some function of the posture.

    Attributes:
        at: where it acts: ``base``, ``joint 3``, ``frame 3``, ``tip`` (`components.stations`).
        component: what acts: ``move x``, ``turn z``, ``force y``, ``moment x``, ...
        function: of quantities of the posture (`core/effects/shapes.py`).
        domain: ranges of these in the data; outside, a quantity counts as at the end.
        scale: prior standard deviation of the amount.
    """

    name = "discovered"
    title = "cause without a name"
    action = "Look there for something that acts like this."
    loaded = True
    bounded = True
    searched = False
    kind = OfPosture

    at: str = place(stations, default="base")
    component: str = place(components, default="move x")
    function: str = place(default="1")
    domain: str = place(default="")
    scale: float = form(1e-3)
    amount: float = parameter("of its component and function", "how much", prior=1e-3)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        unit = _quotient(COMPONENTS[self.component].unit, self.of.units(arm))
        return with_prior(self.declared(), unit=unit, prior=self.scale)

    @property
    def joints(self) -> tuple[int, ...]:
        kind, _, row = self.at.partition(" ")
        return (int(row),) if kind == "joint" else ()

    def history_joints(self, arm: Arm) -> tuple[int, ...]:
        return tuple(dict.fromkeys(j for q in self.of.quantities for j in q.joints))

    def outside(self, posture: Posture) -> list[tuple[str, ...]]:
        """Which quantities of N postures lie outside the data, and so count as at their end."""
        made: list[tuple[str, ...]] = [()] * posture.count
        for factor in {f.of: f for f in self.of.factors}.values():
            read = factor.quantity.read(posture)  # type: ignore[attr-defined]
            slack = _SLACK * (factor.high - factor.low)
            for row, x in enumerate(np.broadcast_to(read, posture.count).tolist()):
                if not factor.low - slack <= x <= factor.high + slack:
                    text = f"{factor.of} {x:.4g} ({factor.low:.4g}..{factor.high:.4g})"
                    made[row] = (*made[row], text)
        return made

    def twists(self, posture: Posture) -> Twists:
        amount = self.amount * self.of.value(lambda q: q.read(posture))  # type: ignore[attr-defined]
        at = Acting.of(posture, self.at)
        return COMPONENTS[self.component].twists(posture, at, amount)


@dataclass(frozen=True)
class DiscoveredView(_OfFunction, Bias):
    """A measuring-side cause without a name: the seen point is displaced by some function of it.

    Attributes:
        axis: ``x``, ``y`` or ``z`` of the base frame; ``distance``: away from the camera, as a
            share of the distance from it.
        function: of the seen point and recorded columns.
        domain, scale: as of `Discovered`.
    """

    name = "discovered_view"
    title = "cause without a name in what is measured"
    action = "Check mount, lenses and calibration of the camera."
    searched = False
    kind = SeenCoordinate

    at = CAMERA

    axis: str = place(views, default="x")
    function: str = place(default="1")
    domain: str = place(default="")
    scale: float = form(1e-3)
    amount: float = parameter("of its function", "displacement of what is seen", prior=1e-3)

    @property
    def component(self) -> str:  # type: ignore[override]
        """Its axis, or `DISTANCE`."""
        return self.axis

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """The amount, in m, or as a share of the distance, per unit of the function."""
        unit = "1" if self.axis == DISTANCE else "m"
        unit = _quotient(unit, self.of.units(arm))
        return with_prior(self.declared(), unit=unit, prior=self.scale)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        at = SeenPoint(point, context)
        by: Scalar = self.amount * self.of.value(lambda q: q.read(at))  # type: ignore[attr-defined]
        if self.axis == DISTANCE and arm.camera is not None:
            ray = spatial.sub(point, arm.camera.position_m)
            return spatial.add(point, spatial.scale(by, ray))
        moved = list(point)
        moved[AXES.index(self.axis)] = moved[AXES.index(self.axis)] + by
        return (moved[0], moved[1], moved[2])


_SLACK = 1e-6


def _quotient(unit: str, over: list[str]) -> str:
    """``N/(rad m)``, ``rad/rad^2``."""
    powers = {u: over.count(u) for u in over}
    below = [u if n == 1 else f"({u})^{n}" if " " in u else f"{u}^{n}" for u, n in powers.items()]
    if not below:
        return unit
    whole = " ".join(below)
    return f"{unit}/({whole})" if " " in whole else f"{unit}/{whole}"
