"""A base that tilts with the overturning moment."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.effects.effect import Arm, Effect, Parameter, Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import typical_loads, with_prior


@dataclass(frozen=True)
class BaseCompliance(Effect):
    """Soft ground, floor or carrier: tilt about x and y per moment about them.

    A carrier is rarely as soft along as across, so that each axis has its own compliance.  With
    both, it equals a bearing tilt of the first joint where the two have the same pivot.
    """

    name = "base_compliance"
    title = "soft base"
    whole = "base"
    action = "Tighten the bolts of the base, brace its stand, or put it on firm ground."
    loaded = True

    about_x: float = parameter("rad/(N m)", "tilt about x per moment", prior=2e-3, lower=0.0)
    about_y: float = parameter("rad/(N m)", "tilt about y per moment", prior=2e-3, lower=0.0)

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: 10 mrad under the arm's typical torque."""
        return with_prior(self.declared(), prior=0.01 / typical_loads(arm)[1])

    def twists(self, posture: Posture) -> Twists:
        x, y, _ = posture.moment(0)
        return {0: (0.0, 0.0, 0.0, self.about_x * x, self.about_y * y, 0.0)}
