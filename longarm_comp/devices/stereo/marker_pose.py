"""The pose of a marker board from its corners in two images.

Unknown: the pose and, because printers stretch paper, one common scale with a prior around 1.
Without the scale, a print 0.5 % too large would change every depth by up to 0.5 %. With it, the two
sources of depth, baseline and size, are weighed by their uncertainty, as is the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from longarm_comp.devices.stereo.camera import Array, StereoRig
from longarm_comp.devices.stereo.triangulate import (
    PixelNoise,
    Triangulation,
    in_front,
    stereo_residuals,
)
from longarm_comp.math.points import kabsch


@dataclass(frozen=True)
class MarkerPose:
    """Pose (4, 4) of the marker in the rig frame.

    `covariance` (6, 6) is of ``[d; delta]`` along the rig axes (m, rad), the rotation about the
    marker's origin; `scale` is seen size / declared size; `residuals` (N, 4) px.
    """

    transform: Array
    covariance: Array
    scale: float
    residuals: Array
    sigma_px: float

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.residuals))))

    def at(self, in_marker: Array) -> tuple[Array, Array]:
        """A point (3,) m fixed to the marker, seen in the rig frame; the pose covariance there."""
        arm = self.transform[:3, :3] @ in_marker
        lever = np.eye(6)
        lever[:3, 3:] = -_cross_matrices(arm[None])[0]
        return self.transform[:3, 3] + arm, lever @ self.covariance @ lever.T


def marker_pose(
    rig: StereoRig,
    corners: Array,
    seen: Triangulation,
    left_px: Array,
    right_px: Array,
    size_tolerance: float,
    noise: PixelNoise,
) -> MarkerPose:
    """Least squares on all corners in both images.

    Args:
        corners: (N, 3) m declared corners of the board, marker frame, N >= 3.
        seen: (N, 3) m the same corners, triangulated one by one; the initial guess.
        size_tolerance: prior standard deviation of the printed size, relative.
        noise: the assumed pixel noise.

    Raises:
        StereoRefusal: BEHIND_CAMERA.
    """
    rotation, translation = kabsch(corners, seen.points, np.ones(len(corners)))
    log_scale = 0.0
    prior = (noise.sigma_px / size_tolerance) ** 2
    for _ in range(8):
        arm = np.exp(log_scale) * corners @ rotation.T
        in_front(rig, arm + translation)
        residuals, by_point = stereo_residuals(rig, arm + translation, left_px, right_px)
        by_pose = np.concatenate(
            [by_point, -by_point @ _cross_matrices(arm), by_point @ arm[..., None]], axis=2
        ).reshape(-1, 7)
        normal = by_pose.T @ by_pose
        normal[6, 6] += prior
        gradient = by_pose.T @ residuals.ravel()
        gradient[6] -= prior * log_scale
        step = np.linalg.solve(normal, gradient)
        translation = translation + step[:3]
        rotation = cv2.Rodrigues(step[3:6])[0] @ rotation
        log_scale += float(step[6])
        if np.max(np.abs(step)) < 1e-8:  # m, rad: the next step is a thousandth of it
            break
    points = np.exp(log_scale) * corners @ rotation.T + translation
    residuals, _ = stereo_residuals(rig, points, left_px, right_px)
    sigma = noise.estimate(residuals, dof=residuals.size - 6)
    normal[6, 6] += (sigma / size_tolerance) ** 2 - prior  # the prior's weight at this sigma
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    covariance = sigma**2 * np.linalg.inv(normal)[:6, :6]
    return MarkerPose(transform, covariance, float(np.exp(log_scale)), residuals, sigma)


def _cross_matrices(vectors: Array) -> Array:
    """(N, 3, 3) matrices S with ``S w = v x w`` for v of `vectors` (N, 3)."""
    return -np.cross(vectors[:, None], np.eye(3))
