"""Fixed placements, and the kinds of numbers that `arm.yaml` declares."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from longarm_comp.core.arm.spatial import Frame, rpy_frame
from longarm_comp.core.yaml_file import Declared

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class Pose(Declared):
    """A fixed placement: translation (m) and fixed-axis roll, pitch, yaw (deg)."""

    xyz_m: Vec3 = (0.0, 0.0, 0.0)
    rpy_deg: Vec3 = (0.0, 0.0, 0.0)

    def frame(self) -> Frame:
        """As a frame in its parent."""
        return rpy_frame(self.xyz_m, tuple(map(math.radians, self.rpy_deg)))  # type: ignore[arg-type]
