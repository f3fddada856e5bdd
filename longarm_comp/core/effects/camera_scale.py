"""Scale error of the stereo head (its baseline, or the marker's size)."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm.spatial import Vec, scale
from longarm_comp.core.effects.camera_view import CameraView
from longarm_comp.core.effects.effect import Arm, Context, parameter


@dataclass(frozen=True)
class CameraScale(CameraView):
    """Everything seen is ``1 + scale`` times as far from the camera."""

    name = "camera_scale"
    title = "camera scale"
    action = "Repeat the stereo calibration; measure the printed target."

    scale: float = parameter("1", "relative scale error", prior=0.02)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        position, depth, axis, lateral = self.split(point, arm)
        factor = 1.0 + self.scale
        return self.join(position, factor * depth, axis, scale(factor, lateral))
