"""A joint's encoder: what it reads where the joint stands."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import Scalar, Vec
from longarm_comp.core.effects.effect import Bias, Parameter, Sites, moving_joints, parameter, place
from longarm_comp.core.effects.joint_term import with_prior


@dataclass(frozen=True)
class Encoder(Bias):
    """An encoder reads ``zero + (1 + scale) q``.

    A potentiometer's scale is right to a hundredth; where an encoder's zero is nobody knows.
    """

    name = "encoder"
    title = "encoder"
    action = "Nothing to repair; set its zero if it matters."
    geometry = True
    sees = frozenset({"joint"})

    joint: int = place(moving_joints)
    zero: float = parameter("rad", "reading where the joint is at 0", 4e-3, unknown=True)
    scale: float = parameter("1", "extra reading per motion", 0.01)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{"joint": row} for row in arm.commanded]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        zero, scale = self.declared()
        if arm.joints[self.joint - 1].type == "prismatic":
            return (*with_prior((zero,), unit="m", prior=1e-3), scale)
        return zero, scale

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        return point

    def read(self, value: Scalar, row: int) -> Scalar:
        return self.zero + (1.0 + self.scale) * value if row == self.joint else value
