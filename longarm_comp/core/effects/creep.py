"""Beams that go on sagging under load: plastics creep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.effects.effect import Arm, Effect, Posture, Sites, Twists, form, parameter
from longarm_comp.core.effects.link_deflection import extra_sag

_TIMES_S = (900.0, 3600.0, 14400.0)


@dataclass(frozen=True)
class Creep(Effect):
    """The declared sag grows by ``amount (1 - exp(-t/time))`` (one Kelvin-Voigt element); the
    time constant (s) counts from the start of the session."""

    name = "creep"
    title = "creep"
    action = "Take the load off between jobs; replace plastic parts that carry load."
    needs = ("t_s",)
    loaded = True

    time: float = form(3600.0, lower=100.0, upper=1e5, tried=_TIMES_S)
    amount: float = parameter("1", "final extra sag over the elastic one", prior=0.3, lower=0.0)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        return [{}] if arm.links else []

    def twists(self, posture: Posture) -> Twists:
        grown = self.amount * (1.0 - np.exp(-posture.context.column("t_s", 0.0) / self.time))
        return extra_sag(posture, grown)
