"""A beam that is softer or stiffer than declared."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Effect, Posture, Twists, parameter, place
from longarm_comp.core.effects.link_deflection import extra_sag
from longarm_comp.core.effects.sites import beams


@dataclass(frozen=True)
class LinkStiffness(Effect):
    """Wrong E or section: the beam bends by ``1 + softness`` times what is declared."""

    name = "link_stiffness"
    title = "beam stiffness"
    action = "Compare section and material with arm.yaml; look for cracks and loose clamps."
    loaded = True

    beam: str = place(beams)
    softness: float = parameter(
        "1",
        "extra deflection over the declared one (EI true = EI / (1 + softness))",
        prior=0.5,
        lower=-0.9,
    )

    def twists(self, posture: Posture) -> Twists:
        return extra_sag(posture, self.softness, self.beam)
