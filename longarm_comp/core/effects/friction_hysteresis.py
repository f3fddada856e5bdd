"""Friction and wind-up: a joint stops short of its command, on the side it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.effects.effect import parameter
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.posture import Posture
from longarm_comp.core.spatial import Twist


@dataclass(frozen=True)
class FrictionHysteresis(JointTerm):
    """Lost motion ``-width/2`` times the direction of approach, whatever the load."""

    name: ClassVar[str] = "friction_hysteresis"
    needs: ClassVar[tuple[str, ...]] = ("approach",)

    width: float = parameter("rad", "full width of the hysteresis", prior=0.01, lower=0.0)

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Half the width against the direction of motion."""
        return self.motion(posture, (-0.5 * self.width) * self.direction(posture))
