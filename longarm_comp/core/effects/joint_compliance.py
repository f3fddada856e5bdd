"""A joint that gives way under gravity torque."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Arm, Parameter, moving_joints, parameter
from longarm_comp.core.effects.joint_term import (
    JointTerm,
    by_drive,
    reach,
    typical_loads,
    with_prior,
)


@dataclass(frozen=True)
class JointCompliance(JointTerm):
    """Linear torsion of gear, shaft and servo: ``dq = compliance * torque`` (Khalil & Besnard).

    A prismatic joint gives way along its axis: m/N.
    """

    name = "joint_compliance"
    title = "soft joint"
    action = "Check keys, clamps and screws of the drive; a stiffer gear or shaft lowers it."
    actions = by_drive(
        hydraulic="Bleed cylinder and hoses of air; check hoses, pins and the valve's leakage.",
        cable="Use stiffer cables or raise their pretension; check their anchors.",
    )
    loaded = True
    elastic = True

    compliance: float = parameter("rad/(N m)", "torsion per gravity torque", prior=4e-3, lower=0.0)

    @classmethod
    def rows(cls, arm: Arm) -> list[int]:
        return moving_joints(arm)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: 20 mrad (2 % of the reach) under the arm's typical load.

        Fitted to real arms with all seats: Justin 43 to 75 mrad, WAM 18 and 24, Pandas up to 11.
        """
        force, torque = typical_loads(arm)
        if arm.joints[self.joint - 1].type == "prismatic":
            return with_prior(self.declared(), unit="m/N", prior=0.002 * reach(arm) / force)
        return with_prior(self.declared(), prior=0.02 / torque)

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, self.compliance * self.load(posture))
