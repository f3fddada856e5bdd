"""Beams that soften as they warm: the modulus of plastics falls by about one percent per kelvin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import Effect, parameter
from longarm_comp.core.effects.link_deflection import extra_sag


@dataclass(frozen=True)
class ThermalSoftening(Effect):
    """The declared sag grows by ``softening (T - T_ref)``."""

    name: ClassVar[str] = "thermal_softening"
    title: ClassVar[str] = "softening by heat"
    action: ClassVar[str] = "Keep the temperature steady, or measure it while the arm works."
    needs: ClassVar[tuple[str, ...]] = ("temperature_c",)
    loaded: ClassVar[bool] = True

    softening: float = parameter("1/K", "extra sag over the declared one, per kelvin", prior=0.01)

    @classmethod
    def sites(cls, arm: Arm) -> Sequence[Mapping[str, Any]]:
        """All beams together."""
        return [{}] if arm.links else []

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """The declared cantilever twist times the extra share."""
        reference = posture.arm.reference_temperature_c
        share = self.softening * (posture.context.column("temperature_c", reference) - reference)
        return extra_sag(posture, share)
