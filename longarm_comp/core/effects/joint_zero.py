"""Zero offset of a joint."""

from __future__ import annotations

import math
from dataclasses import dataclass

from longarm_comp.core.effects.effect import Arm, Parameter, Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import JointTerm, by_drive, with_prior


@dataclass(frozen=True)
class JointZero(JointTerm):
    """The joint stands at ``q + offset``: the encoder's or servo horn's zero is off."""

    name = "joint_zero"
    title = "zero offset"
    types = ("revolute", "prismatic")
    action = "Set the zero of the servo or encoder again."
    actions = by_drive(
        hydraulic="Set the zero of the joint's angle or length sensor again.",
        motor="Reference the axis again, or set the encoder's zero.",
        cable="Reference the joint again; look for a cable that slipped or stretched.",
    )
    geometry = True
    displaces_joint = True

    offset: float = parameter("rad", "joint value at command zero", prior=4e-3)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior from the row's tolerance, else 4 mrad or 1 mm."""
        joint = arm.joints[self.joint - 1]
        if joint.type == "prismatic":
            return with_prior(self.declared(), unit="m", prior=joint.tolerance.d_m or 1e-3)
        declared = joint.tolerance.theta_deg
        return with_prior(self.declared(), prior=math.radians(declared) if declared else 4e-3)

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, self.offset)
