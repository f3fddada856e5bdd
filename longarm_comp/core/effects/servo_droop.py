"""A position-controlled servo that gives way until its error is worth a correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core import spatial
from longarm_comp.core.arm import Arm
from longarm_comp.core.effects.effect import Parameter, parameter
from longarm_comp.core.effects.joint_term import JointTerm, typical_loads, with_prior
from longarm_comp.core.posture import Posture
from longarm_comp.core.spatial import Twist


@dataclass(frozen=True)
class ServoDroop(JointTerm):
    """Proportional sag plus deadband: ``sag * torque + deadband * sign(torque)``.

    With no deadband it cannot be told from `joint_compliance`: report both.
    """

    name: ClassVar[str] = "servo_droop"
    loaded: ClassVar[bool] = True

    sag: float = parameter("rad/(N m)", "proportional droop per torque", prior=4e-3, lower=0.0)
    deadband: float = parameter("rad", "half-width of the deadband", prior=5e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior of the sag: 20 mrad under the arm's typical torque."""
        sag, deadband = self.declared()
        return (*with_prior((sag,), prior=0.02 / typical_loads(arm)[1]), deadband)

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """The droop about the joint's axis."""
        load = self.load(posture)
        return self.motion(posture, self.sag * load + self.deadband * spatial.sign(load))
