"""A sliding beam that tilts in its guide by the clearance over the overlap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm, Beam
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import Twist
from longarm_comp.core.effects.effect import parameter
from longarm_comp.core.effects.joint_term import JointTerm


@dataclass(frozen=True)
class TelescopeClearance(JointTerm):
    """Tilt ``clearance / overlap(q)`` in the direction of the moment at the guide.

    The overlap is what is left of the sliding body inside the beam before it; the tilt
    acts at the mouth of that beam.  A moment decides only the direction, so the tilt is
    the same under any load.
    """

    name: ClassVar[str] = "telescope_clearance"
    loaded: ClassVar[bool] = True

    clearance: float = parameter("m", "play of the body in its guide", prior=3e-4, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Prismatic joints with a beam of length rest that slides in another."""
        return arm.joints[row - 1].type == "prismatic" and _slider(arm, row) is not None

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Rotation about the lateral moment's direction at the mouth of the outer beam."""
        slider = _slider(posture.arm, self.joint)
        assert slider is not None and slider.body_length_m is not None
        elements = posture.chain.rows[self.joint - 1].elements_d
        mouth = posture.bearing(self.joint)
        out: spatial.Scalar = 0.0
        for e in elements:
            if e.beam is slider:
                out = out + posture.lengths[e.station]
            else:
                mouth = e.station
        tilt = self.clearance / (slider.body_length_m - out)
        x, y, _ = posture.moment(mouth)
        size = spatial.sqrt(x * x + y * y + 1e-12)
        return {mouth: (0.0, 0.0, 0.0, tilt * x / size, tilt * y / size, 0.0)}


def _slider(arm: Arm, row: int) -> Beam | None:
    """The sliding beam of a row: of length rest, with a body long enough to overlap always."""
    beams = [b for b in arm.links if b.row == row and b.role == "d"]
    joint = arm.joints[row - 1]
    for beam in beams[1:]:
        if beam.length_m == "rest" and beam.body_length_m is not None:
            fixed = sum(b.length_m for b in beams if b.length_m != "rest")
            if beam.body_length_m > joint.d_m + joint.limits[1] - fixed:
                return beam
    return None
