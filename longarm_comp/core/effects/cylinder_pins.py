"""The pins of a joint's cylinder stand elsewhere than declared."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Posture, Twists, parameter
from longarm_comp.core.effects.joint_term import JointTerm


@dataclass(frozen=True)
class CylinderPins(JointTerm):
    """The joint that the declared length of its cylinder stands at, with other pins.

    The law of cosines at a fixed length, to first order in the pins' places.  A scale error of the
    cylinder's length sensor is the same as both distances wrong by its share.
    """

    name = "cylinder_pins"
    title = "places of the cylinder's pins"
    action = (
        "Measure the distances from the joint's axis to both pins; set the length sensor's scale."
    )
    geometry = True

    near: float = parameter("m", "distance of the pin before the joint", prior=2e-3)
    far: float = parameter("m", "distance of the pin on the part that turns", prior=2e-3)
    length: float = parameter("m", "length at which the sensor reads zero", prior=2e-3)

    @classmethod
    def fits(cls, arm: Arm, row: int) -> bool:
        return arm.joints[row - 1].cylinder is not None

    def twists(self, posture: Posture) -> Twists:
        """``(length L - near (a - b cos) - far (b - a cos)) / (L lever)``."""
        cylinder = posture.arm.joints[self.joint - 1].cylinder
        assert cylinder is not None
        q = posture.q[posture.arm.commanded.index(self.joint)]
        a, b, cosine = cylinder.near_m, cylinder.far_m, spatial.cos(cylinder.angle(q))
        pins = self.near * (a - b * cosine) + self.far * (b - a * cosine)
        missing = self.length - pins / cylinder.length(q)
        return self.motion(posture, missing / cylinder.lever(q))
