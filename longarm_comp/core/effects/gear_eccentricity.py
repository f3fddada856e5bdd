"""An eccentric gear, pulley or encoder disc: an error periodic in the joint angle."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Posture, Twists, form, parameter
from longarm_comp.core.effects.joint_term import JointTerm, by_drive


@dataclass(frozen=True)
class GearEccentricity(JointTerm):
    """``cosine cos(order q) + sine sin(order q)``, with so many periods per turn of the joint."""

    name = "gear_eccentricity"
    title = "eccentric gear"
    action = "Seat the gear wheel or encoder disc again, or replace it."
    actions = by_drive(
        hydraulic="Check the linkage's pins and the seat of the angle sensor.",
        cable="Seat the drum or sheave again, or replace it.",
    )
    free_levels = 3

    order: int = form(1, tried=(1, 2))
    cosine: float = parameter("rad", "cosine amplitude", prior=2e-3)
    sine: float = parameter("rad", "sine amplitude", prior=2e-3)

    @property
    def place(self) -> str:
        """Each order of a joint on its own: real gears have several."""
        return f"{self.where}, order {self.order}"

    def twists(self, posture: Posture) -> Twists:
        angle = float(self.order) * posture.q[posture.arm.commanded.index(self.joint)]
        amount = self.cosine * spatial.cos(angle) + self.sine * spatial.sin(angle)
        return self.motion(posture, amount)
