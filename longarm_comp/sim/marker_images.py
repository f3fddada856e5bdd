"""Printed markers for the rendered cameras. Marker frame: centre, x right, y up."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.errors import InputError

Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class Plate:
    """A printed plate: `texture` (H, W) uint8 stretched over `size_m` (width, height)."""

    texture: Grey
    size_m: tuple[float, float]


def tag_plate(
    tag_m: float,
    gap_m: float = 0.0,
    columns: int = 1,
    rows: int = 1,
    dictionary: str = "DICT_4X4_50",
    first_id: int = 0,
    print_scale: float = 1.0,
) -> Plate:
    """A grid of tags, ids along the rows from the top left, a white margin of 0.2 tags.

    `print_scale` is the printed size over the declared size.
    """
    tag_px = 30 * _dictionary(dictionary).markerSize
    gap_px, margin_px = round(gap_m / tag_m * tag_px), round(0.2 * tag_px)
    pitch = tag_px + gap_px
    if abs(gap_px / tag_px - gap_m / tag_m) > 1e-9:
        raise InputError("tag plate", "gap_m", gap_m, f"a multiple of tag_m / {tag_px}")
    height = rows * pitch - gap_px + 2 * margin_px
    width = columns * pitch - gap_px + 2 * margin_px
    texture = np.full((height, width), 255, dtype=np.uint8)
    for index in range(rows * columns):
        row, column = divmod(index, columns)
        top, left = margin_px + row * pitch, margin_px + column * pitch
        texture[top : top + tag_px, left : left + tag_px] = cv2.aruco.generateImageMarker(
            _dictionary(dictionary), first_id + index, tag_px
        )
    texel = tag_m / tag_px * print_scale
    return Plate(texture, (width * texel, height * texel))


def charuco_plate(
    square_m: float, tag_m: float, columns: int, rows: int, dictionary: str = "DICT_4X4_50"
) -> Plate:
    """A ChArUco board of `columns` x `rows` squares, drawn by OpenCV, without a margin."""
    board = cv2.aruco.CharucoBoard((columns, rows), square_m, tag_m, _dictionary(dictionary))
    texture = board.generateImage((160 * columns, 160 * rows))
    return Plate(np.asarray(texture, dtype=np.uint8), (columns * square_m, rows * square_m))


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    known = sorted(key for key in vars(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        raise InputError("plate", "dictionary", name, ", ".join(known))
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
