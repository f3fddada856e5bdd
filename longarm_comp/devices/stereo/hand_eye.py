"""Pose of the camera in the base frame, from predicted and seen tips.

For every posture i ``base_tip_i = Z tip_i`` with tip_i as the camera sees it. It is the
translational half of the robot-world calibration AX = ZB (Zhuang, Roth & Sudhakar, IEEE T-RA
10(4), 1994), which is all that a point measurement supports; least squares on 6 unknowns.

An arm that sags by centimetres moves its predicted tips: the camera then takes part of the error
as its own pose. `covariance` covers noise, not that; calibrate arm and camera together for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from longarm_comp.core.errors import JobError
from longarm_comp.devices.stereo.camera import Array
from longarm_comp.math.points import kabsch


@dataclass(frozen=True)
class HandEye:
    """Pose (4, 4) of the camera in the base frame.

    `covariance` is (6, 6) of the pose (``[d; delta]``, base axes); `residuals` (N, 3) m are seen -
    predicted, in camera axes; `outliers` are the indices that were left out.
    """

    camera_in_base: Array
    covariance: Array
    residuals: Array
    outliers: tuple[int, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square length of the residuals that count, m."""
        kept = np.delete(self.residuals, self.outliers, axis=0)
        return float(np.sqrt(np.mean(np.sum(np.square(kept), axis=1))))


def hand_eye(tips: Array, seen: Array, covariances: Array) -> HandEye:
    """Fit the camera's pose.

    Args:
        tips: (N, 3) m predicted, base frame; N more than 2, not on one line.
        seen: (N, 3) m the same in the camera frame.
        covariances: (N, 3, 3) m^2 of `seen`, camera frame.
    """
    from scipy.optimize import least_squares  # slow to import, and no node of the graph needs it

    count = len(seen)
    turn, move = kabsch(seen, tips, np.ones(count))

    def off(unknown: Array) -> Array:
        """Seen - predicted (N, 3) m, camera axes, of place and turn of the camera."""
        return seen - (tips - unknown[:3]) @ cv2.Rodrigues(unknown[3:])[0] @ turn

    def weighed(unknown: Array) -> Array:
        return np.einsum("nij,nj->ni", white, off(unknown))

    white = np.linalg.inv(np.linalg.cholesky(covariances))
    unknown = np.concatenate([move, np.zeros(3)])
    kept = np.arange(count)
    for _ in range(3):
        fit = least_squares(
            lambda x, rows: weighed(x)[rows].ravel(), unknown, args=(kept,), x_scale="jac"
        )
        unknown, normal = fit.x, fit.jac.T @ fit.jac
        _check_condition(normal)
        distance = np.linalg.norm(weighed(unknown), axis=1)
        # times the median normalised distance
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
    """Raise `JobError` for a normal matrix that leaves a combination of unknowns undetermined."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    eigenvalues = np.linalg.eigvalsh(normal * scale * scale[:, None])
    if eigenvalues[0] < 1e-7:
        raise JobError(
            "hand-eye: the tips do not determine all unknowns; let them reach over more",
            smallest_eigenvalue=float(eigenvalues[0]),
        )
