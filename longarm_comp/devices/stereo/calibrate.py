"""Calibration of a stereo rig from pictures of a flat board (Zhang's method, through OpenCV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.target import Corners, Target
from longarm_comp.devices.stereo.triangulate import triangulate

_FEWEST_PAIRS = 4
"""Zhang's method: a picture gives two equations for five numbers of a camera; one to spare."""
FEWEST_CORNERS = 8
"""Seen by both cameras: four fix a plane's picture, as many again average their noise."""
_ACCURATE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-10)


@dataclass(frozen=True)
class StereoCalibration:
    """A calibrated rig and how well it fits.

    Args:
        rig: frame = the raw left optical frame; lengths in the unit of the board's points.
        rms_px: of the boards' reprojection, both cameras.
        used: indices of the pairs that were fitted.
        rejected: indices of pairs with too few corners or with outlying residuals.
    """

    rig: StereoRig
    rms_px: float
    used: tuple[int, ...]
    rejected: tuple[int, ...]


def calibrate_stereo(
    board: Target,
    pairs: Sequence[tuple[Corners, Corners]],
    size: tuple[int, int],
) -> StereoCalibration:
    """Intrinsics with plumb-bob distortion of both cameras and the transform between them.

    Pairs whose triangulation residuals exceed twice the median are left out and the rest
    fitted again: hand-held boards move between exposures that are not simultaneous.
    """
    common = [np.intersect1d(left.ids, right.ids, return_indices=True) for left, right in pairs]
    usable = [i for i, (ids, _, _) in enumerate(common) if len(ids) >= FEWEST_CORNERS]
    if len(usable) < _FEWEST_PAIRS:
        allowed = f"{_FEWEST_PAIRS} or more with {FEWEST_CORNERS} corners seen by both cameras"
        raise InputError("stereo calibration", "pairs", len(usable), allowed)
    objects = {i: _flat(board.points(common[i][0])) for i in usable}
    lefts = {i: _flat(pairs[i][0].pixels[common[i][1]]) for i in usable}
    rights = {i: _flat(pairs[i][1].pixels[common[i][2]]) for i in usable}
    try:
        cameras = [
            cv2.calibrateCamera(
                [objects[i] for i in usable], [seen[i] for i in usable], size, None, None
            )
            for seen in (lefts, rights)
        ]
        used = usable
        for _ in range(3):
            rms, k_l, d_l, k_r, d_r, turn, move, *_ = cv2.stereoCalibrate(
                [objects[i] for i in used],
                [lefts[i] for i in used],
                [rights[i] for i in used],
                cameras[0][1],
                cameras[0][2],
                cameras[1][1],
                cameras[1][2],
                size,
                flags=cv2.CALIB_USE_INTRINSIC_GUESS,
                criteria=_ACCURATE,
            )
            right_from_left = np.vstack([np.hstack([turn, move.reshape(3, 1)]), [0, 0, 0, 1]])
            rig = StereoRig.from_extrinsics((k_l, d_l), (k_r, d_r), right_from_left, size)
            off = np.full(len(pairs), np.nan)
            for i in usable:
                off[i] = triangulate(rig, lefts[i].reshape(-1, 2), rights[i].reshape(-1, 2)).rms_px
            keep = [i for i in usable if off[i] <= 2.0 * np.median(off[used])]
            if keep == used or len(keep) < _FEWEST_PAIRS:
                break
            used = keep
    except cv2.error as error:
        raise JobError("stereo calibration failed", opencv=str(error)) from error
    if not rms < 2.0:
        raise JobError("stereo calibration does not fit the pictures", rms_px=float(rms))
    rejected = tuple(i for i in range(len(pairs)) if i not in used)
    return StereoCalibration(rig, float(rms), tuple(used), rejected)


def _flat(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points, dtype=np.float32).reshape(len(points), 1, -1)
