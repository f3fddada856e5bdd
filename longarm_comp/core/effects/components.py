"""Where a discovered effect acts and what it does there: a twist, or a wrench on the beams.

Besides the unit twists and wrenches: something that gives under the load, and a weight.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import BASE, Posture, Twists
from longarm_comp.core.arm.spatial import ZERO, Frame, Scalar, Twist, Vec
from longarm_comp.core.effects.link_deflection import bent
from longarm_comp.core.effects.quantities import AXES

BASE_PLACE, TIP_PLACE = "base", "tip"


def stations(arm: Arm) -> list[str]:
    """Where something may act: the base, every joint's bearing, every row's end, the tip.

    The axes are those of what the joint carries: they turn with it.
    """
    each = (f"{kind} {joint.id}" for kind in ("joint", "frame") for joint in arm.joints)
    return [BASE_PLACE, *each, TIP_PLACE]


@dataclass(frozen=True)
class Acting:
    """A place at a posture: the station that a twist acts at; the pose at whose origin, in the
    base frame, a wrench acts."""

    station: int
    frame: Frame

    @classmethod
    def of(cls, posture: Posture, place: str) -> Acting:
        if place == TIP_PLACE:
            tip = posture.arm.tip
            station = posture.frame(tip.frame)
            frame = posture.frames[station]
            return cls(station, frame._replace(p=frame.transform(tip.position_m)))
        kind, _, row = place.partition(" ")
        stand = posture.bearing if kind == "joint" else posture.frame
        station = stand(int(row)) if row else BASE
        return cls(station, posture.frames[station])


@dataclass(frozen=True)
class _Component(ABC):
    """What acts at a place, along axis 0, 1, 2; None where the posture says which way."""

    word: ClassVar[str]
    unit: ClassVar[str]

    axis: int | None = None

    @property
    def name(self) -> str:
        """As it is stored: ``force y``, ``weight``."""
        return self.word if self.axis is None else f"{self.word} {AXES[self.axis]}"

    @abstractmethod
    def twists(self, posture: Posture, at: Acting, amount: Scalar) -> Twists:
        """Twists by station of `amount` of it."""

    def along(self, amount: Scalar) -> Vec:
        x, y, z = (amount if k == self.axis else 0.0 for k in range(3))
        return (x, y, z)


class Move(_Component):
    """A displacement."""

    word = "move"
    unit = "m"

    def twists(self, posture: Posture, at: Acting, amount: Scalar) -> Twists:
        return {at.station: (*self.along(amount), *ZERO)}


class Turn(_Component):
    """A rotation."""

    word = "turn"
    unit = "rad"

    def twists(self, posture: Posture, at: Acting, amount: Scalar) -> Twists:
        return {at.station: (*ZERO, *self.along(amount))}


class Give(_Component):
    """A rotation under the moment that is carried there, across the place's z axis."""

    word = "give"
    unit = "rad/(N m)"

    def twists(self, posture: Posture, at: Acting, amount: Scalar) -> Twists:
        x, y, _ = posture.moment(at.station)
        return {at.station: (*ZERO, amount * x, amount * y, 0.0)}


class Wrench(_Component):
    """A load: it bends the declared beams between the base and the place."""

    @abstractmethod
    def loads(self, posture: Posture, at: Acting, amount: Scalar) -> tuple[Vec, Vec]:
        """Force (N) and moment (N m) in the base's axes."""

    def twists(self, posture: Posture, at: Acting, amount: Scalar) -> Twists:
        """To first order, every element as a cantilever under what the load makes of its end."""
        pushed, turned = self.loads(posture, at, amount)
        made: dict[int, Twist] = {}
        for row in posture.chain.rows:
            for element in row.elements_a + row.elements_d:
                if element.station > at.station:
                    continue
                end = posture.frames[element.station]
                lever = spatial.sub(at.frame.p, end.p)
                moment = spatial.add(turned, spatial.cross(lever, pushed))
                here = end.unrotate(pushed), end.unrotate(moment)
                made[element.station] = bent(posture, element, *here)
        return made


class Force(Wrench):
    """A force at the place."""

    word = "force"
    unit = "N"

    def loads(self, posture: Posture, at: Acting, amount: Scalar) -> tuple[Vec, Vec]:
        return at.frame.rotate(self.along(amount)), ZERO


class Moment(Wrench):
    """A moment at the place."""

    word = "moment"
    unit = "N m"

    def loads(self, posture: Posture, at: Acting, amount: Scalar) -> tuple[Vec, Vec]:
        return ZERO, at.frame.rotate(self.along(amount))


class Weight(Wrench):
    """A force at the place, the way that gravity pulls."""

    word = "weight"
    unit = "N"

    def loads(self, posture: Posture, at: Acting, amount: Scalar) -> tuple[Vec, Vec]:
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
"""Components by the name that stands for them in a model file."""


def components(arm: Arm) -> list[str]:
    """Names of the components that an arm can have: loads need declared beams to bend."""
    return [n for n, c in COMPONENTS.items() if arm.links or not isinstance(c, Wrench)]
