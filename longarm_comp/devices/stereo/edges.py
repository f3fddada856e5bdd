"""Sub-pixel tag corners, by intersecting lines fitted to the sides of the black square.

A corner found by looking at the corner itself moves inwards as the image blurs; the middle of a
straight step edge does not move. So each side is located by the centre of gravity of the grey
gradient across it, away from its ends, and a line is fitted to those points.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.devices.stereo.camera import Array

_ALONG = np.linspace(0.12, 0.88, 24)  # where on a side the edge is located
_STEP_PX = 0.25
_BEFORE = [3, 0, 1, 2]  # the side that ends in each corner
_REACH = (0.7, 0.5, 0.45, 0.45)  # half window across a side, in cells; one pass each


def refine_quads(grey: NDArray[np.uint8], quads: Array, modules: int) -> Array:
    """Sub-pixel corners (N, 4, 2) of dark squares on light ground.

    Args:
        quads: (N, 4, 2) px, corners in order around each tag, good to about a pixel.
        modules: cells along a side, border included: the edge is sought within one cell of it.
    """
    quads = np.asarray(quads, dtype=float)
    for share in _REACH:
        start, end = quads, np.roll(quads, -1, axis=1)
        along = end - start
        length = np.linalg.norm(along, axis=2)
        normal = np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None]
        reach = float(np.clip(share * length.min() / modules, 1.0, 4.0))
        across = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
        feet = start[:, :, None] + _ALONG[:, None] * along[:, :, None]  # (N, 4, 24, 2)
        at = feet[..., None, :] + across[:, None] * normal[:, :, None, None]
        flat = at.reshape(-1, across.size, 2).astype(np.float32)
        values = cv2.remap(
            grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        rise = np.abs(np.diff(values.astype(float), axis=1))
        rise = np.maximum(rise - 0.15 * rise.max(axis=1, keepdims=True), 0.0)  # noise, paper
        middle = (across[1:] + across[:-1]) / 2
        offset = (rise @ middle / np.maximum(rise.sum(axis=1), 1e-9)).reshape(feet.shape[:3])
        edge = feet + offset[..., None] * normal[:, :, None]
        quads = _intersections(edge, quads)
    return quads


def _intersections(edge: Array, fallback: Array) -> Array:
    """Corners where the lines through the points `edge` (N, 4, M, 2) of neighbouring sides meet."""
    centre = edge.mean(axis=2)
    x, y = np.moveaxis(edge - centre[:, :, None], -1, 0)
    angle = 0.5 * np.arctan2(2 * np.sum(x * y, axis=2), np.sum(x * x - y * y, axis=2))
    nx, ny = -np.sin(angle), np.cos(angle)  # across the direction of most spread
    offset = nx * centre[..., 0] + ny * centre[..., 1]
    before = [a[:, _BEFORE] for a in (nx, ny, offset)]
    cross = before[0] * ny - before[1] * nx
    parallel = np.abs(cross) < 1e-3
    cross = np.where(parallel, 1.0, cross)
    u = (before[2] * ny - before[1] * offset) / cross
    v = (before[0] * offset - before[2] * nx) / cross
    corners = np.stack([u, v], axis=-1)
    lost = parallel | (np.linalg.norm(corners - fallback, axis=-1) > 4.0)
    return np.where(lost[..., None], fallback, corners)
