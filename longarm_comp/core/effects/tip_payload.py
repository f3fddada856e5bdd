"""Undeclared mass at the tip."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.posture import Lumped, Posture, Twists
from longarm_comp.core.effects.effect import Arm, Effect, Parameter, parameter
from longarm_comp.core.effects.joint_term import typical_loads, with_prior


@dataclass(frozen=True)
class TipPayload(Effect):
    """The tip carries more (or less) than declared.

    It has no twist of its own: its weight acts through every elastic effect of the model.
    """

    name = "tip_payload"
    title = "load at the tip"
    whole = "tip"
    action = "Weigh what the tip carries and declare it in arm.yaml."
    loaded = True

    mass: float = parameter("kg", "mass beyond the declared payload", prior=0.1)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: a tenth of the arm's weight; the carried mass cannot become negative."""
        weight = typical_loads(arm)[0] / 9.81
        held = arm.payload.mass_kg if arm.payload else 0.0
        return with_prior(self.declared(), prior=max(0.1 * weight, 1e-6), lower=-held)

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        at = posture.arm.payload or posture.arm.tip
        return (Lumped(posture.frame(at.frame), self.mass, at.position_m),)

    def twists(self, posture: Posture) -> Twists:
        return {}
