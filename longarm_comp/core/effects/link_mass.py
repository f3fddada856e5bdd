"""Undeclared mass along the arm."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.posture import Lumped, Posture, Twists
from longarm_comp.core.arm.spatial import ZERO
from longarm_comp.core.effects.effect import Arm, Effect, Parameter, Sites, parameter, place
from longarm_comp.core.effects.joint_term import typical_loads, with_prior
from longarm_comp.core.effects.sites import rows


@dataclass(frozen=True)
class LinkMass(Effect):
    """The arm is heavier (or lighter) at a row than declared: links, drives, cables, hoses.

    The mass is lumped at the frame's origin.  One between two frames is a part at each.  It has no
    twist of its own: its weight acts through every elastic effect of the model.
    """

    name = "link_mass"
    title = "mass along the arm"
    action = (
        "Weigh the links with all that they carry (drives, cables, hoses) and correct arm.yaml."
    )
    loaded = True

    frame: int = place(rows)
    mass: float = parameter("kg", "mass beyond the declared ones", prior=0.1)

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """Each frame that beams carry, but for the one where `tip_payload` is."""
        first = min((beam.row for beam in arm.links), default=len(arm.joints))
        tip = (arm.payload or arm.tip).frame
        return [{"frame": row} for row in rows(arm) if first < row and row != tip]

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior: a tenth of the arm's weight."""
        return with_prior(self.declared(), prior=max(0.1 * typical_loads(arm)[0] / 9.81, 1e-6))

    def masses(self, posture: Posture) -> tuple[Lumped, ...]:
        return (Lumped(posture.frame(self.frame), self.mass, ZERO),)

    def twists(self, posture: Posture) -> Twists:
        return {}
