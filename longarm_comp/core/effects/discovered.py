"""Effects without a name that a diagnosis found: place, component and function are data.

One instance is one term: an amount times a function of the posture, which acts as one component at
one place.  A component is a twist, a wrench on the declared beams, a compliance or a weight.
`core/identify/discover` finds the terms; a model holds any number of them.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import ORDER, Context
from longarm_comp.core.arm.posture import BASE, Posture, Twists
from longarm_comp.core.arm.spatial import ZERO, Frame, Scalar, Twist, Vec
from longarm_comp.core.effects.effect import Bias, Effect, Parameter, form, parameter, place
from longarm_comp.core.effects.link_deflection import bent
from longarm_comp.core.effects.quantities import (
    AXES,
    OfHistory,
    OfPosture,
    Recorded,
    SeenCoordinate,
    SeenPoint,
)
from longarm_comp.core.effects.shapes import LARGEST, Function, FunctionError, function
from longarm_comp.core.errors import InputError

BASE_PLACE, TIP_PLACE = "base", "tip"


def stations(arm: Arm) -> list[str]:
    """List the places where a term may act: the base, every joint, every row's frame, the tip.

    The axes at a joint turn with the joint.
    """
    each = (f"{kind} {joint.id}" for kind in ("joint", "frame") for joint in arm.joints)
    return [BASE_PLACE, *each, TIP_PLACE]


def _find_station(posture: Posture, place: str) -> tuple[int, Frame]:
    """Return a place's station, at which twists act, and its pose in the base frame."""
    if place == TIP_PLACE:
        tip = posture.arm.tip
        station = posture.frame(tip.frame)
        frame = posture.frames[station]
        return station, frame._replace(p=frame.transform(tip.position_m))
    kind, _, row = place.partition(" ")
    stand = posture.bearing if kind == "joint" else posture.frame
    station = stand(int(row)) if row else BASE
    return station, posture.frames[station]


@dataclass(frozen=True)
class _Component(ABC):
    """A twist or load at a place."""

    word: ClassVar[str]  # its name without the axis
    unit: ClassVar[str]  # of its amount

    axis: int | None = None  # 0, 1 or 2; None if the posture determines the direction

    @property
    def name(self) -> str:
        """Its name in a model file: ``force y``, ``weight``."""
        return self.word if self.axis is None else f"{self.word} {AXES[self.axis]}"

    @abstractmethod
    def twists(self, posture: Posture, station: int, frame: Frame, amount: Scalar) -> Twists:
        """Return the twists (m, rad), by station, of an amount (in `unit`) of the component.

        Args:
            station, frame: the place, as returned by `_find_station`.
        """

    def along(self, amount: Scalar) -> Vec:
        x, y, z = (amount if k == self.axis else 0.0 for k in range(3))
        return (x, y, z)


class Move(_Component):
    word = "move"
    unit = "m"

    def twists(self, posture: Posture, station: int, frame: Frame, amount: Scalar) -> Twists:
        return {station: (*self.along(amount), *ZERO)}


class Turn(_Component):
    word = "turn"
    unit = "rad"

    def twists(self, posture: Posture, station: int, frame: Frame, amount: Scalar) -> Twists:
        return {station: (*ZERO, *self.along(amount))}


class Give(_Component):
    """A compliance: the place tilts about its x and y axes in proportion to the moments there."""

    word = "give"
    unit = "rad/(N m)"

    def twists(self, posture: Posture, station: int, frame: Frame, amount: Scalar) -> Twists:
        x, y, _ = posture.moment(station)
        return {station: (*ZERO, amount * x, amount * y, 0.0)}


class Wrench(_Component):
    """A load: it bends the declared beams between the base and the place."""

    @abstractmethod
    def loads(self, posture: Posture, frame: Frame, amount: Scalar) -> tuple[Vec, Vec]:
        """Return the force (N) and moment (N m) of an amount of the load, in the base's axes."""

    def twists(self, posture: Posture, station: int, frame: Frame, amount: Scalar) -> Twists:
        """Bend every element as a cantilever under the load at its end, to first order."""
        pushed, turned = self.loads(posture, frame, amount)
        made: dict[int, Twist] = {}
        for element in posture.chain.elements:
            if element.station <= station:
                end = posture.frames[element.station]
                lever = spatial.sub(frame.p, end.p)
                moment = spatial.add(turned, spatial.cross(lever, pushed))
                here = end.unrotate(pushed), end.unrotate(moment)
                made[element.station] = bent(posture, element, *here)
        return made


class Force(Wrench):
    word = "force"
    unit = "N"

    def loads(self, posture: Posture, frame: Frame, amount: Scalar) -> tuple[Vec, Vec]:
        return frame.rotate(self.along(amount)), ZERO


class Moment(Wrench):
    word = "moment"
    unit = "N m"

    def loads(self, posture: Posture, frame: Frame, amount: Scalar) -> tuple[Vec, Vec]:
        return ZERO, frame.rotate(self.along(amount))


class Weight(Wrench):
    """A force at the place in the direction of gravity."""

    word = "weight"
    unit = "N"

    def loads(self, posture: Posture, frame: Frame, amount: Scalar) -> tuple[Vec, Vec]:
        size = float(np.linalg.norm(posture.arm.gravity_mps2))
        return spatial.scale(amount * (1.0 / max(size, 1e-9)), posture.gravity), ZERO


COMPONENTS: dict[str, _Component] = {
    component.name: component
    for component in (
        *(kind(axis) for kind in (Move, Turn, Force, Moment) for axis in range(3)),
        Give(),
        Weight(),
    )
}
"""Components by their names in a model file."""


def components(arm: Arm) -> list[str]:
    """List the names of the components on an arm; loads only if it declares beams to bend."""
    return [n for n, c in COMPONENTS.items() if arm.links or not isinstance(c, Wrench)]


CAMERA, DISTANCE = "camera", "distance"
MEASURED = "what is measured"
"""Text for the place of measuring-side terms."""


def views(arm: Arm) -> list[str]:
    """List the directions in which seen points may be displaced.

    They are the axes and, with a declared camera, the distance from it.
    """
    return [*AXES, *([DISTANCE] if arm.camera is not None else [])]


class _OfFunction:
    """The common base of `Discovered` and `DiscoveredView`: the function and its checks."""

    name: ClassVar[str]
    kind: ClassVar[type]  # of the quantities that it may depend on, besides recorded columns
    at: str
    component: str
    function: str
    domain: str
    scale: float
    amount: float

    @property
    def where(self) -> str:
        """Its place and component, as ``joint 5, force y`` or ``what is measured, x``."""
        return f"{MEASURED if self.at == CAMERA else self.at}, {self.component}"

    @cached_property
    def of(self) -> Function:
        """The function that `function` and `domain` describe; FunctionError if they are invalid."""
        return function(self.function, self.domain)

    @property
    def place(self) -> str:
        return f"{self.where}, {self.function}"

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for q in self.of.quantities for name in q.inputs))

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
            if not abs(value) <= LARGEST:
                allowed = f"a number within +-{LARGEST:g}"
                raise InputError(where, f"{self.name}.{field}", value, allowed)
        if not self.scale > 0:
            raise InputError(where, f"{self.name}.scale", self.scale, "above 0")


@dataclass(frozen=True)
class Discovered(_OfFunction, Effect):
    """A cause without a name: an amount of a twist or load, as some function of the posture.

    Attributes:
        at: the place: ``base``, ``joint 3``, ``frame 3``, ``tip`` (`stations`).
        component: the component: ``move x``, ``turn z``, ``force y``, ``moment x``, ...
        function: text of a function of quantities of the posture (`core/effects/shapes.py`).
        domain: ranges of these quantities in the data; outside its range a quantity counts as at
            the end.
        scale: prior standard deviation of the amount.
    """

    name = "discovered"
    title = "cause without a name"
    action = "Look there for something that acts like this."
    loaded = True
    searched = False
    kind = OfPosture

    at: str = place(stations, default="base")
    component: str = place(components, default="move x")
    function: str = place(default="1")
    domain: str = place(default="")
    scale: float = form(1e-3)
    amount: float = parameter("of its component and function", "how much", prior=1e-3)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        unit = _divide_unit(COMPONENTS[self.component].unit, self.of.units(arm))
        return self.with_prior(self.scale, unit=unit)

    @cached_property
    def joints(self) -> tuple[int, ...]:
        kind, _, row = self.at.partition(" ")
        return (int(row),) if kind == "joint" else ()

    def history_joints(self, arm: Arm) -> tuple[int, ...]:
        sides = (q for q in self.of.quantities if isinstance(q, OfHistory))
        return tuple(dict.fromkeys(q.joint for q in sides))

    def outside(self, posture: Posture) -> list[tuple[str, ...]]:
        """List, for each of N postures, the quantities outside their range in the data, in words.

        Their values count as at the end of the range.
        """
        made: list[tuple[str, ...]] = [()] * posture.count
        for factor in {f.of: f for f in self.of.factors if f.of != ORDER}.values():
            read = factor.quantity.read(posture)
            slack = 1e-6 * (factor.high - factor.low)
            for row, x in enumerate(np.broadcast_to(read, posture.count).tolist()):
                if not factor.low - slack <= x <= factor.high + slack:
                    text = f"{factor.of} {x:.4g} ({factor.low:.4g}..{factor.high:.4g})"
                    made[row] = (*made[row], text)
        return made

    def change_beyond(self, posture: Posture) -> np.ndarray:
        """Estimate the possible error (N,) outside the data, in the component's unit."""
        return abs(self.amount) * self.of.change_beyond(lambda q: q.read(posture))

    def twists(self, posture: Posture) -> Twists:
        amount = self.amount * self.of.value(lambda q: q.read(posture))
        return COMPONENTS[self.component].twists(posture, *_find_station(posture, self.at), amount)


@dataclass(frozen=True)
class DiscoveredView(_OfFunction, Bias):
    """A measuring-side cause without a name: the seen point is displaced by some function of it.

    Attributes:
        axis: direction of the displacement: ``x``, ``y`` or ``z`` of the base frame, or
            ``distance``: away from the camera, as a fraction of the distance from it.
        function: text of a function of the seen point and recorded columns.
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
        """The direction in which the seen point is displaced: an axis, or `DISTANCE`."""
        return self.axis

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Return the amount per unit of the function, in m or as a fraction of the distance."""
        unit = "1" if self.axis == DISTANCE else "m"
        unit = _divide_unit(unit, self.of.units(arm))
        return self.with_prior(self.scale, unit=unit)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        at = SeenPoint(point, context)
        by: Scalar = self.amount * self.of.value(lambda q: q.read(at))
        if self.axis == DISTANCE and arm.camera is not None:
            ray = spatial.sub(point, arm.camera.position_m)
            return spatial.add(point, spatial.scale(by, ray))
        moved = list(point)
        moved[AXES.index(self.axis)] = moved[AXES.index(self.axis)] + by
        return (moved[0], moved[1], moved[2])


def _divide_unit(unit: str, over: list[str]) -> str:
    """Return the text of a unit divided by the product of others: ``N/(rad m)``, ``rad/rad^2``."""
    powers = {u: over.count(u) for u in over}
    below = [u if n == 1 else f"({u})^{n}" if " " in u else f"{u}^{n}" for u, n in powers.items()]
    if not below:
        return unit
    whole = " ".join(below)
    return f"{unit}/({whole})" if " " in whole else f"{unit}/{whole}"
