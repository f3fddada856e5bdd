"""Play in the pins of a joint's cylinder."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Posture, Twists, form, parameter
from longarm_comp.core.effects.joint_term import BLEND, GATES, JointTerm


@dataclass(frozen=True)
class CylinderPlay(JointTerm):
    """As `Backlash`, but worn pins shift the cylinder: the joint turns by play over lever."""

    name = "cylinder_play"
    title = "play in the cylinder's pins"
    action = "Renew the pins and bushes of the cylinder."
    needs = ("approach",)
    loaded = True

    gate: float = form(0.0, lower=0.0, upper=1.0, tried=GATES)
    blend: float = form(BLEND, lower=0.01, upper=0.5)
    width: float = parameter("m", "play of both pins along the cylinder", prior=1e-3, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        return arm.joints[row - 1].cylinder is not None

    def twists(self, posture: Posture) -> Twists:
        cylinder = posture.arm.joints[self.joint - 1].cylinder
        assert cylinder is not None
        lever = spatial.absolute(cylinder.lever(posture.q[posture.arm.commanded.index(self.joint)]))
        side = self.side(posture, self.gate, self.blend)
        return self.motion(posture, 0.5 * self.width / lever * side)
