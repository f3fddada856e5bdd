"""Errors of a camera or tracker in the points that it measures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.measuring import Instrument
from longarm_comp.core.arm.spatial import Vec, add, dot, scale, sub
from longarm_comp.core.effects.effect import Bias, parameter
from longarm_comp.core.effects.slow_changes import change_so_far, slowing


@dataclass(frozen=True)
class CameraScale(Bias):
    """Every point is seen ``1 + scale`` times as far from the camera as it is."""

    name = "camera_scale"
    title = "camera scale"
    action = "Repeat the stereo calibration; measure the printed target."
    instruments: ClassVar[Mapping[Instrument, str]] = {"camera": ""}
    part = "camera"

    scale: float = parameter("1", "relative scale error", prior=0.02)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        assert arm.camera is not None
        return add(point, scale(self.scale, sub(point, arm.camera.position_m)))


@dataclass(frozen=True)
class CameraRadial(Bias):
    """Radial lens distortion: offsets from the optical axis are seen ``1 + k1 r^2`` times as large.

    r is the tangent of the angle to the optical axis (Brown).
    """

    name = "camera_radial"
    title = "lens distortion"
    action = "Calibrate the lens again, with targets up to the edges of the image."
    instruments: ClassVar[Mapping[Instrument, str]] = {"camera": ""}
    part = "camera"

    k1: float = parameter("1", "first radial coefficient left over", prior=0.05)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        assert arm.camera is not None
        ray, axis = sub(point, arm.camera.position_m), arm.camera.optical_axis
        ahead = scale(dot(ray, axis) / dot(axis, axis), axis)
        lateral = sub(ray, ahead)
        r2 = dot(lateral, lateral) / dot(ahead, ahead)
        return add(point, scale(self.k1 * r2, lateral))


@dataclass(frozen=True)
class CameraDrift(Bias):
    """The measured points drift with time: at a constant rate, or ever slower, as in a warm-up.

    If a diagnosis is almost certain of the drift, its model takes targets in the measuring frame as
    it was at the session's first row, because a surveyor marks the points before the session.
    """

    name = "camera_drift"
    title = "drift of the measurements"
    action = "Fix the mount of what measures and let it warm up; measure again in random order."
    instruments: ClassVar[Mapping[Instrument, str]] = {
        "camera": "Fix the cameras' mount and let them warm up; measure again in random order.",
        "tracker": "Let the tracker warm up; check its stand; measure its home point again.",
        "total_station": "Check tripod and level; sight a fixed prism first and last.",
    }
    needs = ("t_s",)

    slowing: float = slowing()
    x: float = parameter("m/h", "drift of the seen points in the first hour", prior=2e-3)
    y: float = parameter("m/h", "drift of the seen points in the first hour", prior=2e-3)
    z: float = parameter("m/h", "drift of the seen points in the first hour", prior=2e-3)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        gone = change_so_far(context, self.slowing)
        return (point[0] + self.x * gone, point[1] + self.y * gone, point[2] + self.z * gone)
