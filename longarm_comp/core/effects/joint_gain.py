"""Scale error of a joint's encoder or potentiometer."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import JointTerm, by_drive


@dataclass(frozen=True)
class JointGain(JointTerm):
    """A revolute joint turns ``(1 + gain) q``; its offset at q = 0 is `joint_zero`."""

    name = "joint_gain"
    title = "scale error of the joint"
    action = "Check the gear ratio and the counts per turn in the servo's settings."
    actions = by_drive(
        motor="Check the gear ratio and the encoder's counts per turn in the drive's settings.",
        hydraulic="Calibrate the joint's angle or length sensor again, at both ends of its travel.",
        cable="Measure the drum's diameter with the cable on it and set the ratio.",
    )
    free_levels = 2

    gain: float = parameter("1", "extra motion per commanded motion", prior=0.05)

    def twists(self, posture: Posture) -> Twists:
        q = posture.q[posture.arm.commanded.index(self.joint)]
        return self.motion(posture, self.gain * q)
