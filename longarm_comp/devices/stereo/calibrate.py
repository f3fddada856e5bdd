"""Calibration of a stereo rig from pictures of a flat board (Zhang's method, by OpenCV).

`hand_eye` finds the rig's pose in the base frame from predicted and seen tips.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.stereo.camera import Array, Camera, StereoRig
from longarm_comp.devices.stereo.mounting import check_mounting
from longarm_comp.devices.stereo.target import Corners, Target
from longarm_comp.devices.stereo.triangulate import triangulate
from longarm_comp.devices.stereo.views import FEWEST_CORNERS, BoardView, list_gaps
from longarm_comp.math.points import kabsch

_FEWEST_PAIRS = 4
"""Zhang's method: a picture gives two equations for a camera's five intrinsic parameters, so three
pictures are enough; one more is required."""
_FROM_GUESS = cv2.CALIB_USE_INTRINSIC_GUESS
_ACCURATE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-10)


@dataclass(frozen=True)
class StereoCalibration:
    rig: StereoRig  # frame = the raw left optical frame; lengths in the unit of the board's points
    rms_px: float  # of the boards' reprojection, both cameras
    used: tuple[int, ...]  # indices of the pairs that were fitted
    rejected: tuple[int, ...]  # indices of pairs with too few corners or with outlying residuals


def calibrate_stereo(
    board: Target, pairs: Sequence[tuple[Corners, Corners]], size: tuple[int, int]
) -> StereoCalibration:
    """Fit intrinsics with plumb-bob distortion of both cameras and the transform between them.

    Pairs whose triangulation residual exceeds twice the median are left out, and the others are
    fitted again: a hand-held board moves between exposures that are not simultaneous.

    Args:
        pairs: corners in the left and the right image of each pair.
        size: (width, height) of the images, px.

    Raises:
        InputError: fewer than four pairs have enough common corners.
        JobError: the fit fails, or its residual is 2 px or more.
    """
    common = [left.shared_corners(right) for left, right in pairs]
    views = {
        i: (_flatten_points(board.points(ids)), _flatten_points(left), _flatten_points(right))
        for i, (ids, left, right) in enumerate(common)
        if len(ids) >= FEWEST_CORNERS
    }
    if len(views) < _FEWEST_PAIRS:
        allowed = f"{_FEWEST_PAIRS} or more with {FEWEST_CORNERS} corners seen by both cameras"
        raise InputError("stereo calibration", "pairs", len(views), allowed)
    try:
        objects, lefts, rights = zip(*views.values(), strict=True)
        k_l, d_l = cv2.calibrateCamera(objects, lefts, size, None, None)[1:3]
        k_r, d_r = cv2.calibrateCamera(objects, rights, size, None, None)[1:3]
        used = list(views)
        for _ in range(3):
            objects, lefts, rights = zip(*(views[i] for i in used), strict=True)
            guess = k_l, d_l, k_r, d_r
            fit = cv2.stereoCalibrate(
                objects, lefts, rights, *guess, size, flags=_FROM_GUESS, criteria=_ACCURATE
            )
            rms, k_l, d_l, k_r, d_r, turn, move, *_ = fit
            left = Camera(k_l, np.eye(3), np.zeros(3), size, d_l)
            rig = StereoRig(left, Camera(k_r, turn, move, size, d_r))
            off = {i: triangulate(rig, *common[i][1:])[1] for i in views}
            limit = 2.0 * np.median([off[i] for i in used])
            keep = [i for i in views if off[i] <= limit]
            if keep == used or len(keep) < _FEWEST_PAIRS:
                break
            used = keep
    except cv2.error as error:
        raise JobError("stereo calibration failed", opencv=str(error)) from error
    if not rms < 2.0:
        raise JobError("stereo calibration does not fit the pictures", rms_px=float(rms))
    rejected = tuple(i for i in range(len(pairs)) if i not in used)
    return StereoCalibration(rig, float(rms), tuple(used), rejected)


def _flatten_points(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points, dtype=np.float32).reshape(len(points), 1, -1)


_HELD_OUT_EVERY = 4
"""Every fourth view is held out: the other three quarters calibrate nearly as well as all."""


@dataclass(frozen=True)
class BoardCalibration:
    fit: StereoCalibration  # of all views
    held_out_mm: float
    """Rms distance, mm, of corners in held-out views from a board of the declared size. They are
    triangulated with a calibration from the other views."""
    held_out: int  # number of held-out views
    distances_m: tuple[float, float]  # distance of the nearest and the farthest board, m


def calibrate_board(
    board: Target, views: Sequence[BoardView], size: tuple[int, int]
) -> BoardCalibration:
    """Calibrate a camera pair from views that cover image, distance and tilt.

    ``size``: (width, height) of the images, px.

    Raises:
        JobError: the views do not cover enough (the message says what is missing), a camera is
            turned, the pictures are paired wrongly, or the fit fails.
    """
    check_mounting(views)
    lacking = list_gaps(views, size)
    if lacking:
        raise JobError("the views are not enough: " + "; ".join(lacking), views=len(views))
    pairs = [(view.left, view.right) for view in views]
    fit = calibrate_stereo(board, pairs, size)
    kept = [pairs[i] for i in fit.used]
    rest = [pair for i, pair in enumerate(kept) if i % _HELD_OUT_EVERY]
    out = kept[::_HELD_OUT_EVERY]
    other = calibrate_stereo(board, rest, size).rig
    squares = []  # m^2, of the distances of triangulated corners from the declared board
    for pair in out:
        ids, points = _shared_points(other, *pair)
        turn, move = kabsch(board.points(ids), points, np.ones(len(ids)))
        squares.append(np.sum((points - board.points(ids) @ turn.T - move) ** 2, axis=1))
    depths = [float(np.median(_shared_points(fit.rig, *pair)[1][:, 2])) for pair in kept]
    rms = 1e3 * float(np.sqrt(np.mean(np.concatenate(squares))))
    return BoardCalibration(fit, rms, len(out), (min(depths), max(depths)))


def _shared_points(rig: StereoRig, left: Corners, right: Corners) -> tuple[np.ndarray, np.ndarray]:
    ids, left_px, right_px = left.shared_corners(right)
    points, _ = triangulate(rig, left_px, right_px)
    return ids, points


@dataclass(frozen=True)
class HandEye:
    """Pose of the camera in the base frame, as fitted by `hand_eye`.

    Attributes:
        camera_in_base: (4, 4) pose, m.
        covariance: (6, 6) of the pose (``[d; delta]``, base axes), m and rad.
        residuals: (N, 3) m, seen - predicted, in camera axes.
        outliers: indices of the rows that were left out.
    """

    camera_in_base: Array
    covariance: Array
    residuals: Array
    outliers: tuple[int, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square length of the residuals without outliers, m."""
        kept = np.delete(self.residuals, self.outliers, axis=0)
        return float(np.sqrt(np.mean(np.sum(np.square(kept), axis=1))))


def hand_eye(tips: Array, seen: Array, covariances: Array) -> HandEye:
    """Fit the camera's pose Z in the base frame: ``tips_i = Z seen_i`` for every posture i.

    It is the translational half of the robot-world calibration AX = ZB (Zhuang, Roth & Sudhakar,
    IEEE T-RA 10(4), 1994), because points have no orientation. Least squares on 6 unknowns.

    Errors of the predicted tips, such as centimetres of sag, go partly into the camera's pose.
    `covariance` covers the noise, not these errors; calibrate arm and camera together.

    Args:
        tips: (N, 3) m, predicted tips, base frame; at least 3 that are not on one line.
        seen: (N, 3) m, the same tips as measured, camera frame.
        covariances: (N, 3, 3) m^2 of `seen`, camera frame.

    Raises:
        JobError: the tips do not determine the pose.
    """
    from scipy.optimize import least_squares  # slow to import, and no node of the graph needs it

    count = len(seen)
    turn, move = kabsch(seen, tips, np.ones(count))

    def off(unknown: Array) -> Array:
        """Return seen - predicted (N, 3), m, camera axes, for a position and rotation (6,)."""
        return seen - (tips - unknown[:3]) @ cv2.Rodrigues(unknown[3:])[0] @ turn

    def weigh_residuals(unknown: Array) -> Array:
        return np.einsum("nij,nj->ni", white, off(unknown))

    white = np.linalg.inv(np.linalg.cholesky(covariances))
    unknown = np.concatenate([move, np.zeros(3)])
    kept = np.arange(count)
    for _ in range(3):
        fit = least_squares(
            lambda x, rows: weigh_residuals(x)[rows].ravel(), unknown, args=(kept,), x_scale="jac"
        )
        unknown, normal = fit.x, fit.jac.T @ fit.jac
        _check_condition(normal)
        distance = np.linalg.norm(weigh_residuals(unknown), axis=1)
        # Outliers are farther than 5 times the median normalised distance
        inliers = np.flatnonzero(distance <= 5.0 * max(float(np.median(distance)), 1e-12))
        if np.array_equal(inliers, kept):
            break
        kept = inliers
    factor = max(float(np.sum(distance[kept] ** 2)) / max(3 * len(kept) - 6, 1), 1.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(unknown[3:])[0] @ turn, unknown[:3]
    outliers = tuple(int(i) for i in np.setdiff1d(np.arange(count), kept))
    return HandEye(pose, factor * np.linalg.inv(normal), off(unknown), outliers)


def _check_condition(normal: Array) -> None:
    """Raise `JobError` if a normal matrix leaves some combination of the unknowns undetermined."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    eigenvalues = np.linalg.eigvalsh(normal * scale * scale[:, None])
    if eigenvalues[0] < 1e-7:
        raise JobError(
            "hand-eye: the tips do not determine all unknowns; let them reach over more",
            smallest_eigenvalue=float(eigenvalues[0]),
        )
