"""Play across a slide whose guide is not declared: what it carries rocks to its heavy side."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import JointTerm
from longarm_comp.core.effects.telescope_clearance import TelescopeClearance


@dataclass(frozen=True)
class SlidePlay(JointTerm):
    """A carriage of constant length tilts by ``tilt`` in the direction of the moment it carries.

    Where the body that slides and its guide are declared, the overlap changes with the
    extension, and `TelescopeClearance` applies.
    """

    name = "slide_play"
    title = "tilting carriage"
    action = "Adjust the preload of the carriage or replace its rollers."
    loaded = True

    tilt: float = parameter("rad", "half of the carriage's free angle", 3e-3, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        prismatic = arm.joints[row - 1].type == "prismatic"
        return prismatic and not TelescopeClearance.fits(arm, row)

    def twists(self, posture: Posture) -> Twists:
        station = posture.frame(self.joint)
        x, y, _ = posture.moment(station)
        tilt = self.tilt / spatial.sqrt(x * x + y * y + 1e-12)
        return {station: (0.0, 0.0, 0.0, tilt * x, tilt * y, 0.0)}
