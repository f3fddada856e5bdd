"""What a camera or tracker makes of the points that it sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.measuring import Instrument
from longarm_comp.core.arm.spatial import Scalar, Vec, add, dot, scale, sub
from longarm_comp.core.effects.effect import Bias, parameter


@dataclass(frozen=True)
class CameraView(Bias):
    """A bias that needs to know where the declared camera is."""

    instruments: ClassVar[Mapping[Instrument, str]] = {"camera": ""}
    part = "camera"

    @staticmethod
    def split(point: Vec, arm: Arm) -> tuple[Vec, Scalar, Vec, Vec]:
        """(camera position, depth, optical axis, lateral part) of a point, m, base frame."""
        assert arm.camera is not None
        size = float(np.linalg.norm(arm.camera.optical_axis))
        axis = tuple(float(c) / size for c in arm.camera.optical_axis)
        ray = sub(point, arm.camera.position_m)
        depth = dot(ray, axis)  # type: ignore[arg-type]
        return arm.camera.position_m, depth, axis, sub(ray, scale(depth, axis))  # type: ignore[arg-type, return-value]

    @staticmethod
    def join(position: Vec, depth: Scalar, axis: Vec, lateral: Vec) -> Vec:
        return add(position, add(scale(depth, axis), lateral))


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


@dataclass(frozen=True)
class CameraDrift(Bias):
    """Seen points drift linearly in time."""

    name = "camera_drift"
    title = "drift of the measurements"
    action = "Fix the mount of what measures and let it warm up; measure again in random order."
    instruments: ClassVar[Mapping[Instrument, str]] = {
        "camera": "Fix the cameras' mount and let them warm up; measure again in random order.",
        "tracker": "Let the tracker warm up; check its stand; measure its home point again.",
        "total_station": "Check tripod and level; sight a fixed prism first and last.",
    }
    needs = ("t_s",)

    x: float = parameter("m/h", "drift of the seen points", prior=2e-3)
    y: float = parameter("m/h", "drift of the seen points", prior=2e-3)
    z: float = parameter("m/h", "drift of the seen points", prior=2e-3)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        hours = context.column("t_s", 0.0) / 3600.0
        return (point[0] + self.x * hours, point[1] + self.y * hours, point[2] + self.z * hours)
