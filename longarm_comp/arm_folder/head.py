"""A stereo head and a marker that see an arm's tip over its range."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from longarm_comp.arm_folder.parameter_file import own_parameters
from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.sim.cameras import CameraPair

_LEVEL = [
    np.array([math.cos(angle), math.sin(angle), 0.0]).round(12)
    for angle in 0.5 * math.pi + 2 * math.pi * np.arange(16) / 16
]
"""Level directions of looking that are tried, base frame."""
_BASELINE = 0.18
"""Distance of the two cameras as a share of their distance to the marker."""


def head_for(arm: Arm) -> dict[str, dict[str, Any]]:
    """Parameters of `stereo_bridge` and `simulated_arm` with the whole range of the tip in view.

    The cameras are those of the package's own `simulated_arm.yaml`, 53 degrees across as webcams
    are. The head looks level, from the side where the marker shows: of 16 directions the one from
    which the marker, mounted for it, is turned away the least over 256 poses. A camera that the
    arm declares stays where it is. The marker has 2 x 2 tags, a fifth of a tag apart; its centre is
    the tip.
    """
    model = declared_model(arm, deflection=False)
    tips = model.pose(sobol(arm, 256, 0).q)
    points, turns = tips[:, :3, 3], tips[:, :3, :3]
    given = arm.camera
    axes = _LEVEL
    if given:
        axes = [np.array(given.optical_axis) / np.linalg.norm(given.optical_axis)]
    axis, mounting = _facing(turns, axes)
    x = np.cross(axis, [0.0, 0.0, 1.0])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    off = points - middle
    across, down, deep = np.abs(off @ x), np.abs(off[:, 2]), off @ axis
    distance, tag = 0.3, 0.02
    own = own_parameters("simulated_arm")
    focal_px, width, height = (own[f"camera.{key}"] for key in ("focal_px", "width", "height"))
    for _ in range(20):  # the marker and the second camera need room of their own
        rim = 1.6 * tag
        # A tag of 22 pixels is found reliably
        tag = math.ceil(1e3 * 22.0 / focal_px * (distance + deep.max())) / 1e3
        ends = [
            (0.9 * 0.5 * width / focal_px, across + rim + 0.5 * _BASELINE * distance),
            (0.9 * 0.5 * height / focal_px, down + rim),
        ]
        distance = max(float((wide / slope - deep).max()) for slope, wide in ends)
        if given:
            distance = float((middle - given.position_m) @ axis)
    baseline = round(_BASELINE * distance, 3)
    position = middle - distance * axis - 0.5 * baseline * x
    if given:
        position = np.array(given.position_m)
    at, along = _rounded(position, 3), _rounded(axis, 9)
    turn = quaternion.from_rotation(CameraPair(tuple(at), tuple(along)).left_in_base[:3, :3])
    marker = {"marker.tag_m": tag, "marker.gap_m": round(tag / 5, 6)}
    return {
        "stereo_bridge": {"hand_eye.xyz": at, "hand_eye.quaternion": _rounded(turn, 12), **marker},
        "simulated_arm": {
            "camera.position": at,
            "camera.axis": along,
            "camera.baseline_m": baseline,
            **marker,
            "marker.mounting": _rounded(mounting, 9),
        },
    }


def _facing(turns: np.ndarray, axes: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Of directions of looking the best (3,), and the plate's rotation vector (3,) on the tip."""
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for axis in axes:
        normal = (-turns.transpose(0, 2, 1) @ axis).mean(axis=0)
        if np.linalg.norm(normal) < 1e-6:
            continue
        normal /= np.linalg.norm(normal)
        facing = -(turns @ normal) @ axis
        # A tag that is turned further from the camera is found unreliably
        score = float((facing > math.cos(math.radians(60.0))).mean() + 0.01 * facing.mean())
        if best is None or score > best[0] + 1e-9:
            best = score, axis, normal
    if best is None:
        raise JobError("the tip turns so much that no camera sees a marker on it at most poses")
    _, axis, normal = best
    up = (turns.transpose(0, 2, 1) @ np.array([0.0, 0.0, 1.0])).mean(axis=0)
    up -= normal * (normal @ up)
    if np.linalg.norm(up) < 1e-3:
        up = np.eye(3)[np.argmin(np.abs(normal))]
        up -= normal * (normal @ up)
    up /= np.linalg.norm(up)
    plate = np.column_stack([np.cross(up, normal), up, normal])
    return axis, cv2.Rodrigues(plate)[0].ravel()


def _rounded(values: np.ndarray, digits: int) -> list[Any]:
    return [round(float(v), digits) + 0.0 for v in values]
