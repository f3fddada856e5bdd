"""Play of a joint: it rests on the side that its load, or its last motion, pushes it to."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Arm, Parameter, Posture, Twists, form, parameter
from longarm_comp.core.effects.joint_term import BLEND, GATES, JointTerm, by_drive, with_prior


@dataclass(frozen=True)
class Backlash(JointTerm):
    """``+-width/2`` to the side of the gravity torque where that exceeds a threshold.

    Below the threshold friction holds the joint on the side it came from (`JointTerm.side`).

    Attributes:
        gate: load under which the approach direction decides, as a share of the arm's
            typical torque (`typical_loads`), or of a quarter of its weight for a slide.
        blend: share of that load over which the two change over.
    """

    name = "backlash"
    title = "play"
    types = ("revolute", "prismatic")
    action = "Tighten or replace the gear, coupling or clamp of the joint."
    actions = by_drive(
        hydraulic="Renew worn pins and bushes of the cylinder and the joint.",
        cable="Raise the cables' pretension; look for worn sheaves.",
    )
    needs = ("approach",)
    loaded = True
    limit_aliases = ("friction_hysteresis",)  # load decides nowhere

    gate: float = form(0.0, lower=0.0, upper=1.0, tried=GATES)
    blend: float = form(BLEND, lower=0.01, upper=0.5)
    width: float = parameter("rad", "full width of the play", prior=0.02, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior 20 mrad, or 0.5 mm for a slide."""
        if arm.joints[self.joint - 1].type == "prismatic":
            return with_prior(self.declared(), unit="m", prior=5e-4)
        return self.declared()

    def twists(self, posture: Posture) -> Twists:
        return self.motion(posture, (0.5 * self.width) * self.side(posture, self.gate, self.blend))
