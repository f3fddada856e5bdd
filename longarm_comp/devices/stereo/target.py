"""Printed targets and their corners in an image: tag boards and ChArUco boards.

The marker frame of every target: origin in its middle, x to the right, y up as printed, z out of
the paper towards the viewer; metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.errors import InputError
from longarm_comp.devices.stereo.camera import Array
from longarm_comp.devices.stereo.saddle import refine_quads, refine_saddles

Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class Corners:
    """Corners found in one image.

    Attributes:
        ids: (N,) unique and rising.
        pixels: (N, 2) px.
        repeated: ids of tags that were seen more than once; their corners are left out.
    """

    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))
    repeated: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.ids)

    def shared_corners(self, other: Corners) -> tuple[NDArray[np.int64], Array, Array]:
        """Return the ids (N,) in both images, and their pixels (N, 2) in this and the other one."""
        ids, here, there = np.intersect1d(self.ids, other.ids, return_indices=True)
        return ids, self.pixels[here], other.pixels[there]


@dataclass(frozen=True)
class TagBoard:
    """A grid of ArUco tags or AprilTags, or a single tag. Each tag gives its four outer corners."""

    tag_m: float  # side of a tag's black square, m
    gap_m: float = 0.0  # white between neighbouring tags, m
    columns: int = 1
    """columns, rows: numbers of tags. Tag ids count along the rows from `first_id` at top left."""
    rows: int = 1
    dictionary: str = "DICT_4X4_50"  # an OpenCV name, such as DICT_4X4_50 or DICT_APRILTAG_36h11
    first_id: int = 0

    def __post_init__(self) -> None:
        _check_size("tag board", tag_m=self.tag_m)
        if min(self.columns, self.rows) < 1 or self.gap_m < 0.0:
            grid = (self.columns, self.rows, self.gap_m)
            raise InputError("tag board", "columns, rows, gap_m", grid, ">= 1, >= 1, >= 0")
        known = len(_load_dictionary(self.dictionary).bytesList)
        if not 0 <= self.first_id <= known - self.columns * self.rows:
            raise InputError("tag board", "first_id", self.first_id, f"ids inside 0..{known - 1}")

    @classmethod
    def of(cls, bridge: Mapping[str, Any]) -> TagBoard:
        """Make the marker from the parameters of `stereo_bridge`, such as ``marker.tag_m``."""
        keys = ("tag_m", "gap_m", "columns", "rows", "dictionary", "first_id")
        return cls(**{key: bridge[f"marker.{key}"] for key in keys})

    @property
    def n_corners(self) -> int:
        return 4 * self.columns * self.rows

    def points(self, ids: NDArray[np.int64]) -> Array:
        """Return the positions (N, 3), m, of corners in the marker frame.

        ``ids``: (N,) 4 (tag id - first_id) + 0..3, clockwise from top left.
        """
        row, column = np.divmod(ids // 4, self.columns)
        pitch = self.tag_m + self.gap_m
        x = (column - (self.columns - 1) / 2) * pitch
        y = ((self.rows - 1) / 2 - row) * pitch
        turn = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])[ids % 4]
        return np.column_stack([x, y, np.zeros(len(ids))]) + np.pad(
            turn * self.tag_m, ((0, 0), (0, 1))
        )

    def detect(self, grey: Grey) -> Corners:
        """Find the tags in an image (H, W), uint8, with OpenCV; refine the corners to sub-pixel."""
        for detector in self._detectors:  # the quick one is enough unless a tag is missing
            quads, tag_ids, _ = detector.detectMarkers(grey)
            if tag_ids is not None and len(tag_ids) >= self.columns * self.rows:
                break
        if tag_ids is None or not len(tag_ids):
            return Corners()
        ours = np.asarray(tag_ids).ravel().astype(np.int64) - self.first_id
        count = np.bincount(ours[ours >= 0], minlength=1)
        mine = (ours >= 0) & (ours < self.columns * self.rows)
        repeated = tuple(int(i) + self.first_id for i in np.unique(ours[mine]) if count[i] > 1)
        keep = [i for i in np.argsort(ours) if mine[i] and count[ours[i]] == 1]
        if not keep:
            return Corners(repeated=repeated)
        refined = refine_quads(grey, np.array([quads[i][0] for i in keep]), self._modules)
        ids = (4 * ours[keep][:, None] + np.arange(4)).ravel()
        return Corners(ids, refined.reshape(-1, 2), repeated)

    @cached_property
    def _modules(self) -> int:
        return int(_load_dictionary(self.dictionary).markerSize) + 2

    @cached_property
    def _detectors(self) -> tuple[cv2.aruco.ArucoDetector, cv2.aruco.ArucoDetector]:
        """A detector with one threshold window, and a thorough one with OpenCV's three.

        An image of 640x480 takes 0.8 and 2.7 ms.
        """
        quick = cv2.aruco.DetectorParameters()
        quick.adaptiveThreshWinSizeMin = quick.adaptiveThreshWinSizeMax = 11
        thorough = cv2.aruco.DetectorParameters()
        known = _load_dictionary(self.dictionary)
        return cv2.aruco.ArucoDetector(known, quick), cv2.aruco.ArucoDetector(known, thorough)


@dataclass(frozen=True)
class CharucoTarget:
    """A chessboard with a tag in every white square; its inner corners are saddle points."""

    square_m: float
    tag_m: float
    columns: int
    rows: int
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        _check_size("charuco board", square_m=self.square_m, tag_m=self.tag_m)
        if min(self.columns, self.rows) < 3 or self.tag_m >= self.square_m:
            shape = (self.columns, self.rows, self.tag_m)
            raise InputError("charuco board", "columns, rows, tag_m", shape, ">= 3, >= 3, < square")
        _load_dictionary(self.dictionary)

    @property
    def n_corners(self) -> int:
        return (self.columns - 1) * (self.rows - 1)

    def points(self, ids: NDArray[np.int64]) -> Array:
        """Return the positions (N, 3), m, of inner corners in the marker frame.

        ``ids``: (N,) counted along the rows from the top left.
        """
        row, column = np.divmod(ids, self.columns - 1)
        x, y = column - (self.columns - 2) / 2, (self.rows - 2) / 2 - row
        return self.square_m * np.column_stack([x, y, np.zeros(len(ids))])

    def detect(self, grey: Grey) -> Corners:
        """Find the inner corners beside recognised tags in an image (H, W), uint8."""
        found, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or not len(ids):
            return Corners()
        order = np.argsort(np.asarray(ids).ravel())
        ids = np.asarray(ids).ravel()[order].astype(np.int64)
        pixels = np.asarray(found, dtype=float).reshape(-1, 2)[order]
        white = (self.square_m - self.tag_m) / 2  # between a corner and the tags beside it
        # The scale of the image: smallest distance of two seen neighbours over a square's side
        apart = np.linalg.norm(pixels[:, None] - pixels, axis=2)
        neighbours = np.linalg.norm(self.points(ids)[:, None] - self.points(ids), axis=2)
        near = np.abs(neighbours - self.square_m) < 1e-6 * self.square_m
        px_per_m = float(apart[near].min() / self.square_m) if np.any(near) else 0.0
        half = int(white * px_per_m)
        return Corners(ids, refine_saddles(grey, pixels, half) if half >= 3 else pixels)

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.tag_m, _load_dictionary(self.dictionary)
        )
        return cv2.aruco.CharucoDetector(board)


Target = TagBoard | CharucoTarget
"""A printed target. `detect` finds its corners in an image; `points` gives their positions."""


def on_one_line(points: Array) -> bool:
    """Tell whether points (N, 3) are nearly on one line, so that they have no pose."""
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return not extent[1] > 0.05 * extent[0]


def _check_size(what: str, **sizes: float) -> None:
    for name, size in sizes.items():
        if not (np.isfinite(size) and size > 0.0):
            raise InputError(what, name, size, "more than 0 m")


def _load_dictionary(name: str) -> cv2.aruco.Dictionary:
    known = sorted(key for key in vars(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        raise InputError("marker", "dictionary", name, ", ".join(known))
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
