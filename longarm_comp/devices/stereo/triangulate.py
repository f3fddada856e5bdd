"""Computes points, and the pose of a marker board, from two images by least squares on pixels.

The start is the homogeneous linear triangulation of Hartley & Zisserman, *Multiple View Geometry*
(2nd ed., 12.2); Gauss-Newton then minimises the pixel error in both images (their 12.3, "gold
standard"), through the lens distortion, and its normal matrix gives the covariance.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.devices.stereo.camera import Array, StereoRig
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.math.points import kabsch


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a corner: an assumed sigma, corrected by residuals.

    The estimated variance is ``(weight sigma^2 + sum r^2) / (weight + dof)``, as with a
    scaled-inverse-chi-square prior, so that few residuals do not make sigma erratic.
    """

    sigma_px: float = 0.04  # assumed standard deviation of a corner in u and in v
    weight: float = 4.0  # weight of the assumed sigma, as a number of residuals

    def estimate(self, residuals_px: ArrayLike, dof: float) -> float:
        """Estimate sigma (px) from residuals (px) and their degrees of freedom."""
        total = self.weight * self.sigma_px**2 + float(np.sum(np.square(residuals_px)))
        count = self.weight + dof
        return float(np.sqrt(total / count)) if count > 0.0 else self.sigma_px


def triangulate(rig: StereoRig, left_px: Array, right_px: Array) -> tuple[Array, float]:
    """Return points (N, 3), m, rig frame, of corners in both images, and their rms residual, px.

    Args:
        left_px, right_px: (N, 2) pixels of the same N >= 1 corners in the original images, with
            their lens distortion.

    Raises:
        StereoRefusal: BEHIND_CAMERA, if a point does not lie in front of both cameras.
    """
    cameras = rig.left, rig.right
    poses = [np.column_stack([camera.rotation, camera.translation]) for camera in cameras]
    rays = [c.rays(pixels)[:, :2].T for c, pixels in zip(cameras, (left_px, right_px), strict=True)]
    null = cv2.triangulatePoints(*poses, *rays).T
    weight = null[:, 3]
    if np.any(np.abs(weight) < 1e-9 * np.linalg.norm(null[:, :3], axis=1)):
        raise StereoRefusal(RefusalReason.BEHIND_CAMERA, depth_m="infinite")
    points = null[:, :3] / weight[:, None]
    # Gauss-Newton from the linear start converges in two steps, to parts in 1e9 of the depth
    for _ in range(2):
        in_front(rig, points)
        residuals, jacobian = stereo_residuals(rig, points, left_px, right_px)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        gradient = jacobian.transpose(0, 2, 1) @ residuals[..., None]
        points = points + np.linalg.solve(normal, gradient)[..., 0]
    in_front(rig, points)
    return points, rms(stereo_residuals(rig, points, left_px, right_px)[0])


def rms(values: Array) -> float:
    """Return the root mean square of numbers."""
    return float(np.sqrt(np.mean(np.square(values))))


def stereo_residuals(
    rig: StereoRig, points: Array, left_px: Array, right_px: Array
) -> tuple[Array, Array]:
    """Return seen - projected (N, 4), px, and the projection's Jacobian (N, 4, 3), px/m.

    The four columns are u, v in the left and u, v in the right image.
    """
    left, left_jacobian = rig.left.project(points)
    right, right_jacobian = rig.right.project(points)
    residuals = np.concatenate([left_px - left, right_px - right], axis=1)
    return residuals, np.concatenate([left_jacobian, right_jacobian], axis=1)


def epipolar_px(rig: StereoRig, left_px: Array, right_px: Array) -> Array:
    """Return the distance (N,), px, of corners from each other's epipolar lines (Sampson)."""
    turn = rig.right.rotation @ rig.left.rotation.T
    essential = _cross_matrices(rig.right.translation - turn @ rig.left.translation) @ turn
    left, right = rig.left.rays(left_px), rig.right.rays(right_px)
    lines_right, lines_left = left @ essential.T, right @ essential
    off = np.einsum("ni,ni->n", right, lines_right)
    slopes = np.hypot(*lines_right[:, :2].T) ** 2 + np.hypot(*lines_left[:, :2].T) ** 2
    focal = float(np.sqrt(rig.left.k[0, 0] * rig.right.k[0, 0]))
    return focal * np.abs(off) / np.sqrt(slopes)


def in_front(rig: StereoRig, points: Array) -> None:
    """Raise StereoRefusal (BEHIND_CAMERA) unless points (N, 3) are in front of both cameras."""
    depth = float(min(rig.left.depth(points).min(), rig.right.depth(points).min()))
    if not depth > 1e-9:
        raise StereoRefusal(RefusalReason.BEHIND_CAMERA, depth_m=round(depth, 6))


@dataclass(frozen=True)
class MarkerPose:
    """Pose of the marker in the rig frame.

    Attributes:
        transform: (4, 4) pose, m.
        covariance: (6, 6) of ``[d; delta]`` along the rig axes, m and rad; the rotation is about
            the marker's origin.
        scale: seen size / declared size.
        residuals: (N, 4) px.
    """

    transform: Array
    covariance: Array
    scale: float
    residuals: Array

    def at(self, in_marker: Array) -> tuple[Array, Array]:
        """Return a point (3,), m, of the marker in the rig frame, and the pose covariance there.

        ``in_marker``: (3,) m, the point in the marker frame.
        """
        arm = self.transform[:3, :3] @ in_marker
        lever = np.eye(6)
        lever[:3, 3:] = -_cross_matrices(arm)
        return self.transform[:3, 3] + arm, lever @ self.covariance @ lever.T


def marker_pose(
    rig: StereoRig,
    corners: Array,
    seen: Array,
    left_px: Array,
    right_px: Array,
    size_tolerance: float,
    noise: PixelNoise,
) -> MarkerPose:
    """Fit the pose, and a scale with a prior around 1, to all corners in both images.

    Printers stretch paper. Without the scale, a print 0.5 % too large would change every depth by
    up to 0.5 %. With it, depth from the baseline and depth from the size are weighted by their
    uncertainties.

    Args:
        corners: (N, 3) m, declared corners of the board, marker frame, N >= 3.
        seen: (N, 3) m, the same corners, triangulated one by one, for the initial guess.
        left_px, right_px: (N, 2) pixels of these corners.
        size_tolerance: prior standard deviation of the printed size, relative.
        noise: the assumed pixel noise.

    Raises:
        StereoRefusal: BEHIND_CAMERA.
    """
    rotation, translation = kabsch(corners, seen, np.ones(len(corners)))
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
    return MarkerPose(transform, covariance, float(np.exp(log_scale)), residuals)


def _cross_matrices(vectors: Array) -> Array:
    """Return matrices S (..., 3, 3) with ``S w = v x w`` for v of `vectors` (..., 3)."""
    return -np.cross(vectors[..., None, :], np.eye(3))
