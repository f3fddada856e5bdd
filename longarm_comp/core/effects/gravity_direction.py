"""A base that leans, so that gravity does not come along its z axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist, Vec, add, cross
from longarm_comp.core.effects.effect import Effect, parameter


@dataclass(frozen=True)
class GravityDirection(Effect):
    """Gravity turned by two small angles about the base's x and y.

    It has no twist of its own: it acts through every elastic effect of the model.  Who levels a
    base by eye or by a bubble leaves some 5 mrad, which is no finding.
    """

    name: ClassVar[str] = "gravity_direction"
    title: ClassVar[str] = "base out of level"
    whole: ClassVar[str] = "base"
    action: ClassVar[str] = "Level the base, or declare the direction of gravity."
    loaded: ClassVar[bool] = True

    about_x: float = parameter("rad", "lean of gravity about base x", prior=0.03, usual=5e-3)
    about_y: float = parameter("rad", "lean of gravity about base y", prior=0.03, usual=5e-3)

    def gravity(self, gravity: Vec) -> Vec:
        """The turned gravity (first order)."""
        return add(gravity, cross((self.about_x, self.about_y, 0.0), gravity))

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """None of its own."""
        return {}
