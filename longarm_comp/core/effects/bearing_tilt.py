"""A bearing that tilts sideways under the moment it carries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import Arm
from longarm_comp.core.effects.effect import Parameter, parameter
from longarm_comp.core.effects.joint_term import JointTerm, typical_loads, with_prior
from longarm_comp.core.posture import Posture
from longarm_comp.core.spatial import Twist


@dataclass(frozen=True)
class BearingTilt(JointTerm):
    """Lateral elasticity of a joint: rotation about x and y per moment about x and y.

    The lateral term of Tenhumberg & Baeuml (HUMANOIDS 2021).
    """

    name: ClassVar[str] = "bearing_tilt"
    loaded: ClassVar[bool] = True

    compliance: float = parameter("rad/(N m)", "tilt per lateral moment", prior=2e-3, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Every commanded joint has a bearing or a guide."""
        return True

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: 10 mrad under the arm's typical torque."""
        return with_prior(self.declared(), prior=0.01 / typical_loads(arm)[1])

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Rotation about the bearing's lateral axes."""
        station = posture.bearing(self.joint)
        x, y, _ = posture.moment(station)
        return {station: (0.0, 0.0, 0.0, self.compliance * x, self.compliance * y, 0.0)}
