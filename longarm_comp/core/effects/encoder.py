"""A joint's encoder: what it reads where the joint stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Scalar, Twist, Vec
from longarm_comp.core.effects.effect import (
    Bias,
    Drive,
    Parameter,
    moving_joints,
    parameter,
    place,
)
from longarm_comp.core.effects.joint_term import JointTerm, with_prior


@dataclass(frozen=True)
class Encoder(Bias):
    """An encoder reads ``zero + (1 + scale) q``.

    A potentiometer's scale is right to a hundredth; where an encoder's zero is nobody knows.
    """

    name: ClassVar[str] = "encoder"
    title: ClassVar[str] = "encoder"
    action: ClassVar[str] = "Nothing to repair; set its zero if it matters."
    geometry: ClassVar[bool] = True
    sees: ClassVar[frozenset[str]] = frozenset({"joint"})

    joint: int = place(moving_joints)
    zero: float = parameter("rad", "reading where the joint is at 0", 4e-3, unknown=True)
    scale: float = parameter("1", "extra reading per motion", 0.01)

    @classmethod
    def sites(cls, arm: Arm) -> Sequence[Mapping[str, Any]]:
        """All commanded joints."""
        return [{"joint": row} for row in arm.commanded]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """The zero in m for a slide."""
        zero, scale = self.declared()
        if arm.joints[self.joint - 1].type == "prismatic":
            return (*with_prior((zero,), unit="m", prior=1e-3), scale)
        return zero, scale

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        """The tip as it is."""
        return point

    def read(self, value: Scalar, row: int) -> Scalar:
        """Its zero and scale on its own joint."""
        return self.zero + (1.0 + self.scale) * value if row == self.joint else value


@dataclass(frozen=True)
class Shaft(JointTerm):
    """Where a joint stands whose encoder reads the commanded value: `Encoder` turned round.

    It has the name and parameters of its encoder, whose uncertainty is its own.
    """

    name: ClassVar[str] = Encoder.name
    searched: ClassVar[bool] = False
    acts: ClassVar[Drive] = "arm"

    zero: float = parameter("rad", "reading where the joint is at 0", 4e-3)
    scale: float = parameter("1", "extra reading per motion", 0.01)

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """From the reading to the joint."""
        read = posture.q[posture.arm.commanded.index(self.joint)]
        return self.motion(posture, (read - self.zero) * (1.0 / (1.0 + self.scale)) - read)
