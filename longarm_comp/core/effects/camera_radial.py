"""Radial distortion that the camera's calibration left over."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.spatial import Vec, dot, scale
from longarm_comp.core.effects.camera_view import CameraView
from longarm_comp.core.effects.effect import Arm, Context, parameter


@dataclass(frozen=True)
class CameraRadial(CameraView):
    """Lateral part times ``1 + k1 r^2``, r the tangent off the optical axis (Brown)."""

    name = "camera_radial"
    title = "lens distortion"
    action = "Calibrate the lens again, with targets up to the edges of the image."

    k1: float = parameter("1", "first radial coefficient left over", prior=0.05)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        position, depth, axis, lateral = self.split(point, arm)
        r2 = dot(lateral, lateral) / (depth * depth)
        return self.join(position, depth, axis, scale(1.0 + self.k1 * r2, lateral))
