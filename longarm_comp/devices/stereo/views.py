"""Views of a calibration board: finds them in image pairs, and lists what they do not cover yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.devices.stereo.found import Limits, find_corners
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import Corners, Grey, Target, on_one_line

FEWEST_CORNERS = 8
"""Smallest number of corners seen by both cameras: four determine a plane's image, four more
average noise."""
FEWEST_VIEWS = 10
"""Smallest number of views, as OpenCV's guide to calibration recommends."""
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")
_NEW_PLACE, _NEW_SIZE, _NEW_TILT_DEG = 0.12, 0.12, 10.0
"""A view is new if the board moved by this share of the image's width, changed its distance by this
share, or its tilt by this angle: about a third of the range that `list_gaps` asks for."""


@dataclass(frozen=True)
class BoardView:
    """One pair of images in which both cameras see the board."""

    left: Corners  # left, right: all corners that each camera sees
    right: Corners
    disparity_px: float  # median shift of the common corners from left to right
    distance_m: float  # distance of the board, roughly
    tilt_deg: tuple[float, float]  # about the image's horizontal and vertical axis, roughly

    def is_new(self, others: Sequence[BoardView], width: int) -> bool:
        """Tell whether each of the other views has another place, distance or tilt of the board.

        ``width``: width of the images, px.
        """
        for other in others:
            shift = self.left.pixels.mean(axis=0) - other.left.pixels.mean(axis=0)
            moved = np.linalg.norm(shift) > _NEW_PLACE * width
            nearer = abs(np.log(self.distance_m / other.distance_m)) > _NEW_SIZE
            tilted = np.abs(np.subtract(self.tilt_deg, other.tilt_deg)).max() > _NEW_TILT_DEG
            if not (moved or nearer or tilted):
                return False
        return True

    def is_still(self, before: BoardView | None) -> bool:
        """Tell whether the board moved by less than 1 px since the view before; False for None."""
        if before is None:
            return False
        _, now, then = self.left.shared_corners(before.left)
        return bool(len(now) and np.linalg.norm(now - then, axis=1).mean() < 1.0)


def find_view(board: Target, left: Grey, right: Grey) -> BoardView:
    """Find the board in a pair of images (H, W), uint8.

    Raises:
        StereoRefusal: the pair cannot be used; its `reason` says why.
    """
    if left.shape != right.shape:
        sizes = {"left": left.shape[::-1], "right": right.shape[::-1]}
        raise StereoRefusal(RefusalReason.WRONG_SIZE, **sizes)
    in_left = find_corners(board, left, "left", Limits())
    in_right = find_corners(board, right, "right", Limits())
    ids, left_px, right_px = in_left.shared_corners(in_right)
    points = board.points(ids)
    if len(ids) < FEWEST_CORNERS or on_one_line(points):
        wanted = f"{FEWEST_CORNERS}, not on one line"
        raise StereoRefusal(RefusalReason.OCCLUDED, corners=len(ids), at_least=wanted)
    shift = np.median(left_px[:, 0] - right_px[:, 0])
    # Distance and tilt for a focal length that is guessed as a share of the image's width
    height, width = left.shape
    k = np.array([[1.2 * width, 0.0, width / 2], [0.0, 1.2 * width, height / 2], [0.0, 0.0, 1.0]])
    _, turn, move = cv2.solvePnP(points, left_px, k, None, flags=cv2.SOLVEPNP_IPPE)
    x, y, z = -cv2.Rodrigues(turn)[0][:, 2]  # towards the scene: z of the board is to the viewer
    tilt = (float(np.degrees(np.arctan2(y, z))), float(np.degrees(np.arctan2(x, z))))
    return BoardView(in_left, in_right, float(shift), float(move[2, 0]), tilt)


def list_gaps(views: Sequence[BoardView], size: tuple[int, int]) -> list[str]:
    """List what the views lack, as instructions; an empty list if they are enough.

    ``size``: (width, height) of the images, px.
    """
    lacking = []
    if len(views) < FEWEST_VIEWS:
        lacking.append(f"more views: {len(views)} of {FEWEST_VIEWS}")
    if not views:
        return lacking
    for side in ("left", "right"):
        bare = [
            "centre" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"
            for row, column in np.argwhere(~_ninths_with_corners(views, side, size))
        ]
        if bare:
            lacking.append(f"{side} camera: no corner at the {', '.join(bare)} of what both see")
    distances = [view.distance_m for view in views]
    # Least ratio of the largest to the smallest distance
    if max(distances) < 1.25 * min(distances):
        ends = f"{min(distances):.2f} to {max(distances):.2f} m"
        lacking.append(f"nearer and farther: all views are from about {ends}")
    for axis, name in enumerate(("horizontal", "vertical")):
        tilts = [view.tilt_deg[axis] for view in views]
        # Least range of the board's tilt about either axis. The focal length is only guessed here
        if np.ptp(tilts) < 30.0:
            ends = f"{min(tilts):.0f} to {max(tilts):.0f} deg"
            lacking.append(f"tilt about the {name} axis: only {ends} yet")
    return lacking


def _ninths_with_corners(
    views: Sequence[BoardView], side: str, size: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return (3, 3) True for each cell with corners, of the part that both cameras see."""
    width, height = size
    shared = max(width - max(0.0, float(np.median([v.disparity_px for v in views]))), 1.0)
    start = width - shared if side == "left" else 0.0
    pixels = np.vstack([getattr(view, side).pixels for view in views])
    across = np.clip((pixels[:, 0] - start) / shared * 3, 0, 2).astype(int)
    down = np.clip(pixels[:, 1] / height * 3, 0, 2).astype(int)
    cells = np.zeros((3, 3), dtype=bool)
    cells[down, across] = True
    return cells
