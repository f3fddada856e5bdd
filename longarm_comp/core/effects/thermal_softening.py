"""Beams that soften as they warm: the modulus of plastics falls by about one percent per kelvin."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Arm, Effect, Posture, Sites, Twists, parameter
from longarm_comp.core.effects.link_deflection import extra_sag


@dataclass(frozen=True)
class ThermalSoftening(Effect):
    """The declared sag grows by ``softening (T - T_ref)``."""

    name = "thermal_softening"
    title = "softening by heat"
    action = "Keep the temperature steady, or measure it while the arm works."
    needs = ("temperature_c",)
    loaded = True

    softening: float = parameter("1/K", "extra sag over the declared one, per kelvin", prior=0.01)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{}] if arm.links else []

    def twists(self, posture: Posture) -> Twists:
        reference = posture.arm.reference_temperature_c
        share = self.softening * (posture.context.column("temperature_c", reference) - reference)
        return extra_sag(posture, share)
