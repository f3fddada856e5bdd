"""Friction and wind-up: a joint stops short of its command, on the side it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import Parameter, form, parameter
from longarm_comp.core.effects.joint_term import JointTerm, with_prior


@dataclass(frozen=True)
class FrictionHysteresis(JointTerm):
    """Lost motion against the direction of approach and, by memory, of the move before it.

    A joint with friction and wind-up is a play operator (Prandtl): it lags by half a width
    against its motion once it has wound through `reach`.  A short final approach turns only
    part of it; the rest remembers the move before: ``side = way / reach - 1`` within +-1.

    Attributes:
        reach: way (rad; a tenth as many m for a slide) in which the joint winds from one side
            to the middle.
    """

    name: ClassVar[str] = "friction_hysteresis"
    needs: ClassVar[tuple[str, ...]] = ("approach",)

    reach: float = form(0.1)
    width: float = parameter("rad", "full width that the approach decides", prior=0.01, lower=0.0)
    memory: float = parameter(
        "rad", "full width that the move before decides", prior=3e-3, lower=0.0
    )

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Every commanded joint can stick."""
        return True

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Priors 10 and 3 mrad, or 0.3 and 0.1 mm for a slide."""
        width, memory = self.declared()
        if arm.joints[self.joint - 1].type == "prismatic":
            return (
                *with_prior((width,), unit="m", prior=3e-4),
                *with_prior((memory,), unit="m", prior=1e-4),
            )
        return width, memory

    @property
    def inputs(self) -> tuple[str, ...]:
        """Side and way of its joint."""
        return ("approach", "travel")

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Half the widths against the directions of motion."""
        way = self.travel(posture)
        sliding = posture.arm.joints[self.joint - 1].type == "prismatic"
        reach = 0.1 * self.reach if sliding else self.reach
        wound = spatial.minimum(abs(way) / reach - 1.0, 1.0) * spatial.sign(way)
        lag = 0.5 * self.width * self.direction(posture) + 0.5 * self.memory * wound
        return self.motion(posture, -1.0 * lag)
