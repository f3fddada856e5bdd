"""A telescoping column that bends although no beam is declared for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import Parameter, parameter
from longarm_comp.core.effects.joint_term import JointTerm, reach, typical_loads, with_prior


@dataclass(frozen=True)
class ColumnBending(JointTerm):
    """The extended part of a slide, ``d + q`` long, is a cantilever of unknown stiffness.

    Moment M and lateral force F at its end turn it by ``(M l + F l^2 / 2) / EI`` and move it by
    ``(M l^2 / 2 + F l^3 / 3) / EI`` (Euler-Bernoulli).
    """

    name: ClassVar[str] = "column_bending"
    title: ClassVar[str] = "bending column"
    action: ClassVar[str] = "Check the column's clamping; a stiffer profile lowers it."
    loaded: ClassVar[bool] = True

    flexibility: float = parameter("1/(N m^2)", "1 / EI of the column", prior=1e-4, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Prismatic joints without a declared beam along them."""
        declared = any(beam.row == row and beam.role == "d" for beam in arm.links)
        return arm.joints[row - 1].type == "prismatic" and not declared

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: 10 mrad over a quarter of the reach under the arm's typical torque."""
        return with_prior(self.declared(), prior=0.01 / (typical_loads(arm)[1] * reach(arm) / 4))

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Turn and lateral motion of the row's frame under the loads there."""
        end = posture.frame(self.joint)
        length = posture.arm.joints[self.joint - 1].d_m + posture.values[self.joint - 1]
        (fx, fy, _), (mx, my, _) = posture.force(end), posture.moment(end)
        along, half = self.flexibility * length, 0.5 * length
        x, y = along * (mx - half * fy), along * (my + half * fx)
        third = length / 3
        return {
            end: (
                along * half * my + along * length * third * fx,
                along * length * third * fy - along * half * mx,
                0.0, x, y, 0.0,
            )
        }  # fmt: skip
