"""A bearing that tilts sideways under the moment it carries."""

from __future__ import annotations

import math
from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Arm, Parameter, Scalar, moving_joints, parameter
from longarm_comp.core.effects.joint_term import JointTerm, typical_loads, with_prior


@dataclass(frozen=True)
class BearingTilt(JointTerm):
    """Lateral elasticity of a joint: its seat turns under the moment across its axis.

    The seat belongs to the link before the joint, so the two axes stand still when the joint
    turns: x is that link's ``x_{i-1}`` (the lateral term of Tenhumberg & Baeuml, HUMANOIDS
    2021), y is across it.  On their arms axes that turn with the joint leave 3.9 mm, these 3.7.
    """

    name = "bearing_tilt"
    title = "soft bearing"
    action = "Check seat and preload of the bearing; replace it if it rocks by hand."
    loaded = True
    elastic = True

    about_x: float = parameter(
        "rad/(N m)", "tilt about x_{i-1} per moment", prior=2e-3, lower=0.0, like="seat"
    )
    about_y: float = parameter(
        "rad/(N m)", "tilt about y' per moment", prior=2e-3, lower=0.0, like="seat"
    )

    @classmethod
    def rows(cls, arm: Arm) -> list[int]:
        return moving_joints(arm)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: 10 mrad under the arm's typical torque.

        First seats of real arms, fitted: Justin 11 to 18 mrad, UR5 1, Pandas 0.2 to 4.
        """
        return with_prior(self.declared(), prior=0.01 / typical_loads(arm)[1])

    def twists(self, posture: Posture) -> Twists:
        """Rotation about the seat's lateral axes, seen in the bearing's."""
        station = posture.bearing(self.joint)
        x, y, _ = posture.moment(station)
        joint = posture.arm.joints[self.joint - 1]
        theta: Scalar = math.radians(joint.theta_offset_deg)
        if joint.type == "revolute":
            theta = theta + posture.values[self.joint - 1]
        c, s = spatial.cos(theta), spatial.sin(theta)
        tilt_x, tilt_y = self.about_x * (c * x - s * y), self.about_y * (s * x + c * y)
        return {station: (0.0, 0.0, 0.0, c * tilt_x + s * tilt_y, c * tilt_y - s * tilt_x, 0.0)}
