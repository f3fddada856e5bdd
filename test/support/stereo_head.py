"""A stereo head, a tag it sees, and pictures of the tag rendered where its pose is known."""

from typing import Any

import cv2
import numpy as np

from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.target import TagBoard
from longarm_comp.math.points import kabsch
from longarm_comp.sim.cameras import CameraPair, Conditions, render, tag_plate

HEAD = CameraPair()
TAG = TagBoard(0.06)
PLATE = tag_plate(0.06)


def marker_pose(
    head: CameraPair, depth: float, rng: np.random.Generator | None = None
) -> np.ndarray:
    """A marker facing the cameras, in both views; turned and moved at random if `rng` is given."""
    camera_T_marker = np.eye(4)
    camera_T_marker[:3, :3] = np.diag([1.0, -1.0, -1.0])
    camera_T_marker[:3, 3] = [head.baseline_m / 2, 0.0, depth]
    if rng is not None:
        turn = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
        camera_T_marker[:3, :3] = camera_T_marker[:3, :3] @ turn
        left = head.baseline_m / depth - 0.33
        camera_T_marker[0, 3] = depth * rng.uniform(max(left, -0.33), 0.33)
        camera_T_marker[1, 3] = depth * rng.uniform(-0.2, 0.2)
    return head.left_in_base @ camera_T_marker


def eye_for(
    head: CameraPair = HEAD, target: Any = TAG, rectified: bool = False, **options: Any
) -> StereoEye:
    """The measurement as the cameras' own messages set it up."""
    rig = StereoRig.from_camera_info(*head.camera_infos(), rectified=rectified)
    return StereoEye(rig, target, head.camera_in_base, **options)


def pair(
    conditions: Conditions | None = None, plate: Any = PLATE, depth: float = 1.2
) -> tuple[Any, Any]:
    """Left and right picture of the tag in front of the head."""
    return render(marker_pose(HEAD, depth), plate, HEAD, np.random.default_rng(3), conditions)


def rigid_rms(points: np.ndarray, seen: np.ndarray) -> float:
    """Rms distance of points (N, 3) from sightings after the best rigid motion."""
    turn, move = kabsch(points, seen, np.ones(len(points)))
    return float(np.sqrt(np.mean(np.sum((seen - points @ turn.T - move) ** 2, axis=1))))
