"""Finds a place for a stereo head and a marker, and tells at which poses the marker is not seen.

All this is computed from geometry alone, without images.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.arm_folder.measured import SIDES, camera_path
from longarm_comp.arm_folder.parameter_file import own_parameters, parameters_of
from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.camera_info import CameraInfo

_LEVEL = [
    np.array([math.cos(angle), math.sin(angle), 0.0]).round(12)
    for angle in 0.5 * math.pi + 2 * math.pi * np.arange(16) / 16
]
"""Horizontal viewing directions to try, base frame."""
_BASELINE = 0.18
"""Distance between the two cameras, as a share of their distance to the marker."""


def head_for(arm: Arm) -> dict[str, dict[str, Any]]:
    """Return parameters of `stereo_bridge` and `simulated_arm`, with cameras that see the tip.

    The cameras are those of the package's own `simulated_arm.yaml`, with a webcam's field of view
    of 53 degrees. The head looks horizontally. Of 16 directions it takes the one in which the
    marker, mounted to face it, is turned away the least over 256 poses. A camera that the arm
    declares keeps its place and direction. The marker has 2 x 2 tags, a fifth of a tag apart, and
    its centre is the tip.

    Raises:
        InputError: a camera that the arm declares looks away from where the tip can be.
    """
    from longarm_comp.sim.cameras import CameraPair  # takes a second, with OpenCV

    tips = declared_model(arm, deflection=False).pose(sobol(arm, 256, 0).q)
    points, turns = tips[:, :3, 3], tips[:, :3, :3]
    given = arm.camera
    axes = _LEVEL
    if given:
        axes = [np.array(given.optical_axis) / np.linalg.norm(given.optical_axis)]
    axis, mounting = _choose_direction(turns, axes)
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
            if not distance > 0.0:
                said = f"looks away: the tip is around {_round_to(middle, 2)}"
                allowed = "position_m and optical_axis of a camera that faces the tip"
                raise InputError(arm.name, "camera", said, allowed)
    baseline = round(_BASELINE * distance, 3)
    position = middle - distance * axis - 0.5 * baseline * x
    if given:
        position = np.array(given.position_m)
    at, along = _round_to(position, 3), _round_to(axis, 9)
    turn = quaternion.from_rotation(CameraPair(tuple(at), tuple(along)).left_in_base[:3, :3])
    marker = {"marker.tag_m": tag, "marker.gap_m": round(tag / 5, 6)}
    return {
        "stereo_bridge": {"hand_eye.xyz": at, "hand_eye.quaternion": _round_to(turn, 12), **marker},
        "simulated_arm": {
            "camera.position": at,
            "camera.axis": along,
            "camera.baseline_m": baseline,
            **marker,
            "marker.mounting": _round_to(mounting, 9),
        },
    }


def _choose_direction(
    turns: np.ndarray, axes: Iterable[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best of some directions (3,), and the marker's rotation vector (3,) on the tip.

    `turns` (M, 3, 3) are orientations of the tip. All are in the base frame.
    """
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
    return axis, quaternion.rotation_vector(quaternion.from_rotation(plate))


def _round_to(values: np.ndarray, digits: int) -> list[Any]:
    return [round(float(v), digits) + 0.0 for v in values]


_TAG_PX = 12.5
"""Smallest tag that is found, px: geometric mean of the sides of its image."""


@dataclass(frozen=True, eq=False)
class View:
    """Two equal cameras side by side, and a marker on the tip.

    Attributes:
        left_in_base: (4, 4) pose of the left camera in the base frame.
        tags: (T, 4, 3) corners of the tags with their margin, tip frame, m.
        normal: (3,) normal of the marker's printed face, tip frame.
        tag_m: side of a tag.
        share: smallest fraction of the tags that both cameras must see.
    """

    left_in_base: np.ndarray
    focal_px: float
    middle_px: tuple[float, float]
    size_px: tuple[int, int]
    baseline_m: float
    tags: np.ndarray
    normal: np.ndarray
    tag_m: float
    share: float

    @classmethod
    def of(cls, bridge: Mapping[str, Any], simulated: Mapping[str, Any]) -> View:
        """Return the view for parameters of `stereo_bridge` and `simulated_arm`, by dotted name."""
        from longarm_comp.devices.stereo.found import Limits  # these take a second, with OpenCV
        from longarm_comp.devices.stereo.target import TagBoard
        from longarm_comp.sim.cameras import CameraPair
        from longarm_comp.sim.plant import mount_plate

        board = TagBoard.of(bridge)
        corners = board.points(np.arange(board.n_corners)).reshape(-1, 4, 3)
        middle = corners.mean(axis=1, keepdims=True)
        # White around a tag that must be in the picture, as a share of the tag. These three are
        # from rendered images: `pytest test/arm_folder/test_collect_preview.py` compares
        wide = middle + (1.0 + 2.0 * 0.1) * (corners - middle)
        on_tip = mount_plate(simulated["marker.mounting"])[:3, :3]
        pair = CameraPair(
            focal_px=simulated["camera.focal_px"],
            size=(simulated["camera.width"], simulated["camera.height"]),
        )
        turn = np.array(bridge["hand_eye.quaternion"])
        return cls(
            quaternion.compute_pose(np.array(bridge["hand_eye.xyz"]), turn),
            pair.focal_px,
            (pair.k[0, 2], pair.k[1, 2]),
            pair.size,
            simulated["camera.baseline_m"],
            (wide - np.array(bridge["tip_in_marker"])) @ on_tip.T,
            on_tip[:, 2],
            board.tag_m,
            Limits().seen_share,
        )

    def look_through(self, left: CameraInfo, right: CameraInfo) -> View:
        """Return the view with the lenses of a camera pair; unchanged if it is not calibrated."""
        if not left.p[0] > 0.0 or not right.p[0] > 0.0:
            return self
        return replace(
            self,
            focal_px=left.p[0],
            middle_px=(left.p[2], left.p[6]),
            size_px=(left.width, left.height),
            baseline_m=-right.p[3] / right.p[0],
        )

    def unseen(self, tips: np.ndarray) -> list[str]:
        """Say for each tip pose (M, 4, 4), base frame, why the cameras cannot measure it, or "".

        At least `share` of the tags must lie in both images, large and turned to the cameras.
        """
        local = np.linalg.inv(self.left_in_base) @ tips
        tags = np.einsum("mij,tkj->mtki", local[:, :3, :3], self.tags) + local[:, None, None, :3, 3]
        found = []  # (M, T) of both cameras: all corners of a tag are in view
        for k in (0, 1):
            corners = self._project_points(tags - [k * self.baseline_m, 0.0, 0.0])
            with np.errstate(invalid="ignore"):
                inside = (corners >= 0.0) & (corners <= np.array(self.size_px) - 1.0)
            found.append(np.asarray(inside.all(axis=(-1, -2))))
        both = (found[0] & found[1]).mean(axis=1) >= self.share
        middle = tags.mean(axis=(1, 2)) - [0.5 * self.baseline_m, 0.0, 0.0]
        normal = local[:, :3, :3] @ self.normal
        depth = np.linalg.norm(middle, axis=1)
        facing = -np.einsum("mi,mi->m", normal, middle) / depth
        pixels = self.focal_px * self.tag_m / depth * np.sqrt(np.clip(facing, 0.0, 1.0))
        why = []
        for k in range(len(tips)):
            if not both[k]:
                left, right = (seen[k].mean() < self.share for seen in found)
                who = "the left camera" if left else "the right camera"
                who = who if left != right else "both cameras"
                why.append(f"out of view of {who} ({self._describe_side(middle[k])})")
            # A tag that is turned further from a camera is not found
            elif facing[k] < np.cos(np.radians(75.0)):
                turned = np.degrees(np.arccos(np.clip(facing[k], -1.0, 1.0)))
                why.append(f"turned away: {turned:.0f} deg")
            elif pixels[k] < _TAG_PX:
                small = f"a tag is {pixels[k]:.0f} px, {np.ceil(_TAG_PX):.0f} needed"
                why.append(f"too far: {depth[k]:.2f} m, {small}")
            else:
                why.append("")
        return why

    def _project_points(self, points: np.ndarray) -> np.ndarray:
        ahead = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return np.asarray(self.focal_px * points[..., :2] / ahead + self.middle_px)

    def _describe_side(self, point: np.ndarray) -> str:
        """Say on which side of the images a point (3,) lies, from the middle of the cameras."""
        if point[2] <= 0.0:
            return "behind"
        x, y = self._project_points(point)
        width, height = self.size_px
        beside, above = abs(x - width / 2) / width, abs(y - height / 2) / height
        if beside >= above:
            return "to the left" if x < width / 2 else "to the right"
        return "above" if y < height / 2 else "below"


def view_beside(arm: Path) -> View | None:
    """Return the cameras' view by the files beside an arm.yaml; None if these are missing."""
    from longarm_comp.devices.stereo.camera_file import read_camera

    folder = arm.absolute().parent
    nodes = ("stereo_bridge", "simulated_arm")
    files = [folder / f"{node}.yaml" for node in nodes]
    if not all(file.is_file() for file in files):
        return None
    bridge, simulated = (parameters_of(node, file) for node, file in zip(nodes, files, strict=True))
    view, calibrated = View.of(bridge, simulated), [camera_path(folder, side) for side in SIDES]
    if not all(file.is_file() for file in calibrated):
        return view
    return view.look_through(*map(read_camera, calibrated))
