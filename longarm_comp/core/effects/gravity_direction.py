"""A base that leans, so that gravity does not come along its z axis."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.spatial import Vec, add, cross
from longarm_comp.core.effects.effect import Effect, Posture, Twists, parameter


@dataclass(frozen=True)
class GravityDirection(Effect):
    """Gravity turned by two small angles about the base's x and y.

    It has no twist of its own: it acts through every elastic effect of the model.  Who levels a
    base by eye or by a bubble leaves some 5 mrad, which is no finding.
    """

    name = "gravity_direction"
    title = "base out of level"
    whole = "base"
    action = "Level the base, or declare the direction of gravity."
    loaded = True

    about_x: float = parameter("rad", "lean of gravity about base x", prior=0.03, usual=5e-3)
    about_y: float = parameter("rad", "lean of gravity about base y", prior=0.03, usual=5e-3)

    def gravity(self, gravity: Vec) -> Vec:
        return add(gravity, cross((self.about_x, self.about_y, 0.0), gravity))

    def twists(self, posture: Posture) -> Twists:
        return {}
