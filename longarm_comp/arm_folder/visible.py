"""At which poses of the tip two cameras see the marker, and why not, by geometry alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.arm_folder.parameter_file import parameters_of
from longarm_comp.core.arm import quaternion
from longarm_comp.devices.camera_info import CameraInfo

_TAG_PX = 12.5
"""A tag that looks smaller is not found: geometric mean of its seen sides, px."""


@dataclass(frozen=True, eq=False)
class View:
    """Two equal cameras side by side, the left at (4, 4) in the base frame; a marker on the tip.

    Attributes:
        tags: (T, 4, 3) corners of the tags with their margin on the tip frame, m.
        normal: (3,) out of the paper, on the tip frame.
        tag_m: side of a tag.
        share: of the tags, that both cameras must see.
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
        """From parameters of `stereo_bridge` and `simulated_arm` by dotted name."""
        from longarm_comp.devices.stereo.found import Limits  # these take a second, with OpenCV
        from longarm_comp.devices.stereo.target import TagBoard
        from longarm_comp.sim.cameras import CameraPair
        from longarm_comp.sim.plant import mounting

        board = TagBoard.of(bridge)
        corners = board.points(np.arange(board.n_corners)).reshape(-1, 4, 3)
        middle = corners.mean(axis=1, keepdims=True)
        # White around a tag that must be in the picture, as a share of the tag. These three are
        # from rendered images: `pytest test/test_collect_preview.py` compares
        wide = middle + (1.0 + 2.0 * 0.1) * (corners - middle)
        on_tip = mounting(simulated["marker.mounting"])[:3, :3]
        pair = CameraPair(
            focal_px=simulated["camera.focal_px"],
            size=(simulated["camera.width"], simulated["camera.height"]),
        )
        turn = np.array(bridge["hand_eye.quaternion"])
        return cls(
            quaternion.pose(np.array(bridge["hand_eye.xyz"]), turn),
            pair.focal_px,
            (pair.k[0, 2], pair.k[1, 2]),
            pair.size,
            simulated["camera.baseline_m"],
            (wide - np.array(bridge["tip_in_marker"])) @ on_tip.T,
            on_tip[:, 2],
            board.tag_m,
            Limits().seen_share,
        )

    def through(self, left: CameraInfo, right: CameraInfo) -> View:
        """The same view through the lenses of a pair; as it is where that is not calibrated."""
        p, across = left.p, right.p
        if not p[0] > 0.0 or not across[0] > 0.0:
            return self
        return replace(
            self, focal_px=p[0], middle_px=(p[2], p[6]), size_px=(left.width, left.height),
            baseline_m=-across[3] / across[0],
        )  # fmt: skip

    def unseen(self, tips: np.ndarray) -> list[str]:
        """For each of the tip poses (M, 4, 4), base frame: why it is not measured, or "".

        Both cameras must see `share` of the tags, large and straight enough.
        """
        local = np.linalg.inv(self.left_in_base) @ tips
        tags = np.einsum("mij,tkj->mtki", local[:, :3, :3], self.tags) + local[:, None, None, :3, 3]
        found = [self._inside(tags - [k * self.baseline_m, 0.0, 0.0]) for k in (0, 1)]
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
                why.append(f"out of view of {who} ({self._where(middle[k])})")
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

    def _projected(self, points: np.ndarray) -> np.ndarray:
        ahead = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return np.asarray(self.focal_px * points[..., :2] / ahead + self.middle_px)

    def _inside(self, tags: np.ndarray) -> np.ndarray:
        """(M, T) whether all of a tag, corners (M, T, 4, 3) in the camera's frame, is in view."""
        pixels = self._projected(tags)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= 0.0) & (pixels <= np.array(self.size_px) - 1.0)
        return np.asarray(inside.all(axis=(-1, -2)))

    def _where(self, point: np.ndarray) -> str:
        """On which side of the images a point (3,) lies, seen from the middle of the cameras."""
        if point[2] <= 0.0:
            return "behind"
        x, y = self._projected(point)
        width, height = self.size_px
        beside, above = abs(x - width / 2) / width, abs(y - height / 2) / height
        if beside >= above:
            return "to the left" if x < width / 2 else "to the right"
        return "above" if y < height / 2 else "below"


def view_beside(arm: Path) -> View | None:
    """What the cameras see by the files beside an arm.yaml; None where there are none."""
    from longarm_comp.arm_folder.camera_files import SIDES, camera_path
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
    return view.through(*map(read_camera, calibrated))
