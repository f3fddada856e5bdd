"""Play of a joint: it rests on the side that its load, or its last motion, pushes it to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import Self

from longarm_comp.core import spatial
from longarm_comp.core.arm import Arm
from longarm_comp.core.effects.effect import parameter
from longarm_comp.core.effects.joint_term import JointTerm, typical_loads
from longarm_comp.core.posture import Posture
from longarm_comp.core.spatial import Twist

_RESTING = 1e-6  # N m: a vertical axis carries no torque but for rounding
GATES = (0.0, 0.03, 0.075, 0.15, 0.3)


@dataclass(frozen=True)
class Backlash(JointTerm):
    """``+-width/2`` to the side of the gravity torque where that exceeds a threshold.

    Below the threshold friction holds the joint where its motion left it: it lags behind,
    on the side it came from.  Between the two the side changes over gradually, within a
    sixth of the threshold, as a gear under a nearly balanced load does.

    Attributes:
        threshold: torque (N m) under which the approach direction decides.
    """

    name: ClassVar[str] = "backlash"
    needs: ClassVar[tuple[str, ...]] = ("approach",)
    loaded: ClassVar[bool] = True

    threshold: float = 0.0
    width: float = parameter("rad", "full width of the play", prior=0.02, lower=0.0)

    @classmethod
    def candidates(cls, arm: Arm) -> list[tuple[Self, ...]]:
        """Each revolute joint, with thresholds at shares of the arm's typical torque."""
        torque = typical_loads(arm)[1]
        rows = cls.rows(arm)
        return [(cls(joint=row, threshold=gate * torque),) for row in rows for gate in GATES]

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Half the width to the side that holds."""
        load = self.load(posture)
        settled = (abs(load) - self.threshold - _RESTING) / (self.threshold / 6 + 0.1 * _RESTING)
        gate = 0.5 + 0.5 * spatial.tanh(settled)
        side = gate * spatial.sign(load) - (1.0 - gate) * self.direction(posture)
        return self.motion(posture, (0.5 * self.width) * side)
