"""Pose of the camera in the base frame, from predicted and seen tips.

Both the camera's pose Z and the marker's place p on the tip may be unknown: for every posture i
``base_T_tip_i p = Z m_i`` with m_i the marker seen by the camera. It is the translational half of
the robot-world calibration AX = ZB (Zhuang, Roth & Sudhakar, IEEE T-RA 10(4), 1994), which is all
that a point measurement supports; least squares on 9 unknowns, or 6 where p is known.

An arm that sags by centimetres moves its predicted tips: the camera then takes part of the error
as its own pose. `covariance` covers noise, not that; calibrate arm and camera together for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.stereo.camera import Array
from longarm_comp.math.points import kabsch


@dataclass(frozen=True)
class HandEye:
    """Pose (4, 4) of the camera in the base frame and the marker's place (3,) m on the tip frame.

    `covariance` is (6, 6) of the pose (``[d; delta]``, base axes) or (9, 9) with the place after
    it where that was unknown; `residuals` (N, 3) m are seen - predicted, in camera axes; `outliers`
    are the indices that were left out.
    """

    camera_in_base: Array
    marker_in_tip: Array
    covariance: Array
    residuals: Array
    outliers: tuple[int, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square length of the residuals that count, m."""
        kept = np.delete(self.residuals, self.outliers, axis=0)
        return float(np.sqrt(np.mean(np.sum(np.square(kept), axis=1))))


def hand_eye(
    base_T_tip: Array,
    seen: Array,
    covariances: Array,
    marker_in_tip: Array | None = None,
) -> HandEye:
    """Fit the camera's pose, and the marker's place where it is not given.

    Args:
        base_T_tip: (N, 4, 4) predicted tip poses.
        seen: (N, 3) m marker positions in the camera frame.
        covariances: (N, 3, 3) m^2 of `seen`, camera frame.
        marker_in_tip: (3,) m if known, else it is estimated too: the tip must then turn about
            two axes at least.
    """
    from scipy.optimize import least_squares  # slow to import, and no node of the graph needs it

    base_T_tip, seen = np.asarray(base_T_tip, dtype=float), np.asarray(seen, dtype=float)
    count = len(seen)
    if base_T_tip.shape != (count, 4, 4) or np.shape(covariances) != (count, 3, 3):
        shapes = (base_T_tip.shape, seen.shape, np.shape(covariances))
        raise InputError("hand-eye", "shapes", shapes, "(N, 4, 4), (N, 3) and (N, 3, 3)")
    free = 6 if marker_in_tip is not None else 9
    if 3 * count <= free:
        raise InputError("hand-eye", "postures", count, f"more than {free // 3}")
    place = np.zeros(3) if marker_in_tip is None else np.asarray(marker_in_tip, dtype=float)
    turns, moves = base_T_tip[:, :3, :3], base_T_tip[:, :3, 3]
    turn, move = kabsch(seen, turns @ place + moves, np.ones(count))

    def off(unknown: Array) -> Array:
        """Seen - predicted (N, 3) m, camera axes, of place and turn of the camera, and the mark."""
        marker = turns @ (place + unknown[6:] if free == 9 else place) + moves
        return seen - (marker - unknown[:3]) @ cv2.Rodrigues(unknown[3:6])[0] @ turn

    def weighed(unknown: Array) -> Array:
        return np.einsum("nij,nj->ni", white, off(unknown))

    white = np.linalg.inv(np.linalg.cholesky(covariances))
    unknown = np.concatenate([move, np.zeros(free - 3)])
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
    factor = max(float(np.sum(distance[kept] ** 2)) / max(3 * len(kept) - free, 1), 1.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(unknown[3:6])[0] @ turn, unknown[:3]
    if free == 9:
        place = place + unknown[6:]
    outliers = tuple(int(i) for i in np.setdiff1d(np.arange(count), kept))
    return HandEye(pose, place, factor * np.linalg.inv(normal), off(unknown), outliers)


def _check_condition(normal: Array) -> None:
    """Raise `JobError` for a normal matrix that leaves a combination of unknowns undetermined."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    eigenvalues = np.linalg.eigvalsh(normal * scale * scale[:, None])
    if eigenvalues[0] < 1e-7:
        raise JobError(
            "hand-eye: the postures do not determine all unknowns; turn the tip more",
            smallest_eigenvalue=float(eigenvalues[0]),
        )
