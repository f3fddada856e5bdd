"""Undeclared mass at the tip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Lumped, Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import Effect, Parameter, parameter
from longarm_comp.core.effects.joint_term import typical_loads, with_prior


@dataclass(frozen=True)
class TipPayload(Effect):
    """The tip carries more (or less) than declared.

    It has no twist of its own: its weight acts through every elastic effect of the model.
    """

    name: ClassVar[str] = "tip_payload"
    title: ClassVar[str] = "load at the tip"
    whole: ClassVar[str] = "tip"
    action: ClassVar[str] = "Weigh what the tip carries and declare it in arm.yaml."
    loaded: ClassVar[bool] = True

    mass: float = parameter("kg", "mass beyond the declared payload", prior=0.1)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: a tenth of the arm's weight; the carried mass cannot become negative."""
        weight = typical_loads(arm)[0] / 9.81
        held = arm.payload.mass_kg if arm.payload else 0.0
        return with_prior(self.declared(), prior=max(0.1 * weight, 1e-6), lower=-held)

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        """The mass at the payload's place, else at the tip."""
        at = posture.arm.payload or posture.arm.tip
        return (Lumped(posture.frame(at.frame), self.mass, at.position_m),)

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """None of its own."""
        return {}
