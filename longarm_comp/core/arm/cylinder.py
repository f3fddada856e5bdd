"""A cylinder that turns a joint through two pins: a triangle with the joint's axis."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.pose import Positive
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.yaml_file import Declared


class Cylinder(Declared):
    """Where the pins of a revolute joint's cylinder are.

    ``length^2 = near^2 + far^2 - 2 near far cos(angle)``, the law of cosines; the angle at the
    joint's axis is ``angle_deg`` at joint value 0 and grows (``grows: 1``) or falls (-1) with it.
    """

    near_m: Positive = Field(description="joint axis to the pin on the part before the joint")
    far_m: Positive = Field(description="joint axis to the pin on the part that turns")
    angle_deg: Annotated[float, Field(gt=0, lt=180)] = Field(
        description="angle between the two at joint value 0"
    )
    grows: Literal[1, -1] = 1

    def angle(self, q: Scalar) -> Scalar:
        """Angle at the joint's axis, rad, at joint value q (rad)."""
        return math.radians(self.angle_deg) + self.grows * q

    def length(self, q: Scalar) -> Scalar:
        """From pin to pin, m."""
        squares = self.near_m**2 + self.far_m**2
        return spatial.sqrt(squares - 2 * self.near_m * self.far_m * spatial.cos(self.angle(q)))

    def lever(self, q: Scalar) -> Scalar:
        """Lengthening per turn, m/rad: the distance from the axis, with the sign of `grows`."""
        area = self.grows * self.near_m * self.far_m * spatial.sin(self.angle(q))
        return area / self.length(q)
