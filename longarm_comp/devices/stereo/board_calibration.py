"""A stereo head from views of a board: coverage, fit, and its error on views that were left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.errors import JobError
from longarm_comp.devices.stereo.calibrate import StereoCalibration, calibrate_stereo
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.target import Corners, Target
from longarm_comp.devices.stereo.triangulate import triangulate
from longarm_comp.devices.stereo.views import BoardView, gaps
from longarm_comp.math.points import kabsch

_HELD_OUT_EVERY = 4
"""Every fourth view is left out: three quarters calibrate nearly as well as all."""


@dataclass(frozen=True)
class BoardCalibration:
    """A calibration and what it is worth.

    Attributes:
        fit: of all views.
        held_out_mm: rms distance of the board's corners, triangulated with a calibration of the
            other views, from a board of the declared size.
        held_out: number of views left out for it.
        distances_m: nearest and farthest board, as calibrated.
    """

    fit: StereoCalibration
    held_out_mm: float
    held_out: int
    distances_m: tuple[float, float]


def calibrated(
    board: Target, views: Sequence[BoardView], size: tuple[int, int]
) -> BoardCalibration:
    """Calibrate a head from views that cover image, distance and tilt."""
    lacking = gaps(views, size)
    if lacking:
        raise JobError("the views are not enough: " + "; ".join(lacking), views=len(views))
    pairs = [(view.left, view.right) for view in views]
    fit = calibrate_stereo(board, pairs, size)
    kept = [pairs[i] for i in fit.used]
    rest = [pair for i, pair in enumerate(kept) if i % _HELD_OUT_EVERY]
    out = kept[::_HELD_OUT_EVERY]
    other = calibrate_stereo(board, rest, size).rig
    squares = [_off(board, other, *pair) for pair in out]
    depths = [_depth(fit.rig, *pair) for pair in kept]
    rms = 1e3 * float(np.sqrt(np.mean(np.concatenate(squares))))
    return BoardCalibration(fit, rms, len(out), (min(depths), max(depths)))


def _points(rig: StereoRig, left: Corners, right: Corners) -> tuple[np.ndarray, np.ndarray]:
    ids, in_left, in_right = np.intersect1d(left.ids, right.ids, return_indices=True)
    return ids, triangulate(rig, left.pixels[in_left], right.pixels[in_right]).points


def _off(board: Target, rig: StereoRig, left: Corners, right: Corners) -> np.ndarray:
    """Squared distances (N,) m^2 of triangulated corners from the declared board."""
    ids, points = _points(rig, left, right)
    turn, move = kabsch(board.points(ids), points, np.ones(len(ids)))
    return np.sum((points - board.points(ids) @ turn.T - move) ** 2, axis=1)


def _depth(rig: StereoRig, left: Corners, right: Corners) -> float:
    return float(np.median(_points(rig, left, right)[1][:, 2]))
