"""Placement error of the camera: the seen points, moved rigidly."""

from __future__ import annotations

from dataclasses import dataclass

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.effect import Arm, Bias, Context, Vec, parameter


@dataclass(frozen=True)
class CameraPose(Bias):
    """The camera's pose in the base frame is not what was declared.

    Position data cannot tell it from `base_pose`; a calibration fits one of the two.
    """

    name = "camera_pose"
    title = "camera pose"
    action = "Fix the camera's mount; repeat the hand-eye calibration after every move of it."
    geometry = True

    x: float = parameter("m", "shift of the seen points", prior=0.05)
    y: float = parameter("m", "shift of the seen points", prior=0.05)
    z: float = parameter("m", "shift of the seen points", prior=0.05)
    rx: float = parameter("rad", "turn of the seen points", prior=0.05)
    ry: float = parameter("rad", "turn of the seen points", prior=0.05)
    rz: float = parameter("rad", "turn of the seen points", prior=0.05)

    def seen(self, point: Vec, context: Context, arm: Arm) -> Vec:
        motion = spatial.exp_large((self.x, self.y, self.z, self.rx, self.ry, self.rz))
        return motion.transform(point)
