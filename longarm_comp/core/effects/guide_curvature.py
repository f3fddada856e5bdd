"""A guide that is not straight: what it carries leans more the further it extends."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import JointTerm


@dataclass(frozen=True)
class GuideCurvature(JointTerm):
    """Constant curvature: the slide turns by ``curvature * q`` and moves by its integral.

    These are the pitch and yaw of a linear axis in ISO 230-1, to first order in its travel.
    """

    name = "guide_curvature"
    title = "curved guide"
    types = ("prismatic",)
    action = "Align the guide rail or replace it."

    about_x: float = parameter("rad/m", "turn about x per travel", prior=5e-3)
    about_y: float = parameter("rad/m", "turn about y per travel", prior=5e-3)

    def twists(self, posture: Posture) -> Twists:
        q = posture.q[posture.arm.commanded.index(self.joint)]
        x, y = self.about_x * q, self.about_y * q
        return {posture.frame(self.joint): (0.5 * q * y, -0.5 * q * x, 0.0, x, y, 0.0)}
