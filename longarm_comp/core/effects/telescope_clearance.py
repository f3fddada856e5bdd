"""A sliding beam that tilts in its guide by the clearance over the overlap."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.beam import Beam
from longarm_comp.core.effects.effect import Arm, Parameter, Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import JointTerm, typical_loads, with_prior


@dataclass(frozen=True)
class TelescopeClearance(JointTerm):
    """Tilt ``clearance / overlap + give * moment / overlap^2`` towards the moment at the guide.

    The overlap is what is left of the sliding body inside the beam before it; the tilt
    acts at the mouth of that beam.  For the clearance a moment decides only the direction.
    The pads at both ends of the overlap also give under load: forces of moment / overlap,
    each with an arm of the overlap.
    """

    name = "telescope_clearance"
    title = "clearance in the telescope"
    action = "Adjust or replace the guide pads; a longer overlap lowers it."
    loaded = True

    clearance: float = parameter("m", "play of the body in its guide", prior=3e-4, lower=0.0)
    give: float = parameter("m/N", "compression of both pads together per force", 1e-5, lower=0.0)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        """Prismatic joints with a beam of length rest that slides in another."""
        return arm.joints[row - 1].type == "prismatic" and _slider(arm, row) is not None

    def parameters(self, arm: Arm) -> tuple[Parameter, ...]:
        """Prior of the give: 3 mrad under the arm's typical torque at half the body's length."""
        slider = _slider(arm, self.joint)
        body = slider.body_length_m if slider and slider.body_length_m else 1.0
        clearance, give = self.declared()
        (give,) = with_prior((give,), prior=3e-3 * (body / 2) ** 2 / typical_loads(arm)[1])
        return clearance, give

    def twists(self, posture: Posture) -> Twists:
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
        overlap = slider.body_length_m - out
        x, y, _ = posture.moment(mouth)
        size = spatial.sqrt(x * x + y * y + 1e-12)
        tilt = self.clearance / (overlap * size) + self.give / (overlap * overlap)
        return {mouth: (0.0, 0.0, 0.0, tilt * x, tilt * y, 0.0)}


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
