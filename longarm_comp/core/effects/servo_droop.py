"""A position-controlled servo that yields to its load until its error is worth a correction."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.posture import Posture, Twists
from longarm_comp.core.effects.effect import Arm, Context, Parameter, form, parameter
from longarm_comp.core.effects.joint_term import (
    BLEND,
    GATES,
    JointTerm,
    by_drive,
    typical_loads,
    with_prior,
)
from longarm_comp.core.errors import InputError


@dataclass(frozen=True)
class ServoDroop(JointTerm):
    """Proportional sag plus deadband: ``sag * torque + deadband * side``.

    With no deadband only a reading of the joint tells it from `joint_compliance`.

    Attributes:
        gate: load under which friction decides the side of the deadband (`JointTerm.side`);
            0 where the load always does.
        blend: share of that load over which the two change over.
    """

    name = "servo_droop"
    title = "servo that yields to its load"
    acts = "servo"
    action = "Raise the gain of the servo or add integral action; otherwise fit a stronger one."
    actions = by_drive(
        hydraulic=(
            "Add integral action to the valve's controller, or check it for leakage and deadband."
        ),
        motor="Raise the gain of the position controller, or add integral action.",
        cable="Raise the gain of the position controller, or measure the angle at the joint.",
    )
    loaded = True
    aliases = ("joint_compliance",)  # a sag is a compliance
    limit_aliases = ("backlash",)  # without sag

    gate: float = form(0.0, lower=0.0, upper=1.0, tried=GATES)
    blend: float = form(BLEND, lower=0.01, upper=0.5)
    sag: float = parameter("rad/(N m)", "proportional droop per torque", prior=4e-3, lower=0.0)
    deadband: float = parameter("rad", "half-width of the deadband", prior=5e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior of the sag: 20 mrad under the arm's typical torque."""
        sag, deadband = self.declared()
        return (*with_prior((sag,), prior=0.02 / typical_loads(arm)[1]), deadband)

    @property
    def inputs(self) -> tuple[str, ...]:
        """The side, where friction decides: with a gate, or on an axis without load."""
        return ("approach",)

    def require(self, context: Context) -> None:
        if self.gate > 0 and not context.has("approach"):
            raise InputError(self.name, "approach", "missing", "a recorded column of the session")

    def twists(self, posture: Posture) -> Twists:
        resting = self.deadband * self.side(posture, self.gate, self.blend)
        return self.motion(posture, self.sag * self.load(posture) + resting)
