"""Two calibrated pinhole cameras in one frame: projection with its Jacobian, and undistortion.

The rig frame is the left optical frame: x right, y down, z forward, metres. For the `CameraInfo` of
raw images it is the *rectified* left frame, because there K, D, R and P share one convention:
``X_camera = R' (X_rig + t)``, ``t = (P[0,3]/P[0,0], 0, 0)``, so the baseline is -P_right[3]/fx.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from longarm_comp.core.errors import InputError
from longarm_comp.devices.camera_info import CameraInfo
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal

Array = NDArray[np.float64]
_MODELS = ("", "plumb_bob", "rational_polynomial")


def check_distortion(model: str, where: str | Path) -> None:
    """Refuse a distortion model that `Camera` does not have, such as a fisheye's ``equidistant``.

    Args:
        where: topic or file for the error message.
    """
    if model not in _MODELS:
        known = " or ".join(name for name in _MODELS if name)
        raise InputError(where, "distortion_model", model, known)


@dataclass(frozen=True)
class Camera:
    """One pinhole camera with Brown-Conrady (plumb bob or rational) distortion.

    Raises:
        StereoRefusal: UNCALIBRATED, if k is zero, not finite, has no focal length or is skewed
            (OpenCV's model has no skew), or if `rotation` is no rotation.
        InputError: more than 8 distortion coefficients are not zero.
    """

    k: Array  # (3, 3) intrinsic matrix, px
    rotation: Array
    """rotation, translation: (3, 3) and (3,) m; ``X_camera = rotation X_rig + translation``."""
    translation: Array
    size: tuple[int, int]  # (width, height), px
    d: Array  # k1 k2 p1 p2 k3 k4 k5 k6 as OpenCV orders them; shorter is padded with zeros

    def __init__(
        self,
        k: ArrayLike,
        rotation: ArrayLike,
        translation: ArrayLike,
        size: tuple[int, int],
        d: ArrayLike = (),
    ) -> None:
        given = np.asarray(d, dtype=float).ravel()
        if np.any(given[8:]):
            raise InputError("camera", "d", given.tolist(), "8 coefficients, zeros after them")
        values = {
            "k": np.array(k, dtype=float).reshape(3, 3),
            "rotation": np.array(rotation, dtype=float).reshape(3, 3),
            "translation": np.array(translation, dtype=float).reshape(3),
            "d": np.pad(given[:8], (0, max(8 - given.size, 0))),
        }
        for name, value in values.items():
            if not np.all(np.isfinite(value)):
                raise StereoRefusal(RefusalReason.UNCALIBRATED, not_finite=name)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        fx, skew, fy = self.k[0, 0], self.k[0, 1], self.k[1, 1]
        if min(fx, fy) <= 0.0 or skew != 0.0:
            raise StereoRefusal(RefusalReason.UNCALIBRATED, fx=fx, fy=fy, skew=skew)
        if abs(np.linalg.det(self.rotation) - 1.0) > 1e-3:
            raise StereoRefusal(
                RefusalReason.UNCALIBRATED, det_rotation=np.linalg.det(self.rotation)
            )
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return pixels (N, 2) of rig points (N, 3), m, and their Jacobian (N, 2, 3), px/m."""
        pixels, by_all = cv2.projectPoints(points, self.rotation, self.translation, self.k, self.d)
        by_camera = by_all[:, 3:6].reshape(-1, 2, 3)  # OpenCV's is by the translation
        return pixels.reshape(-1, 2), by_camera @ self.rotation

    @property
    def pose(self) -> Array:
        """Pose (4, 4) of this camera's frame in the rig frame, m."""
        made = np.eye(4)
        made[:3, :3] = self.rotation.T
        made[:3, 3] = -self.rotation.T @ self.translation
        return made

    def rays(self, pixels: Array) -> Array:
        """Return undistorted directions (N, 3), z = 1, of pixels (N, 2), in this camera's frame."""
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        flat = np.ascontiguousarray(pixels, dtype=float).reshape(-1, 1, 2)
        rays = cv2.undistortPoints(flat, self.k, self.d, criteria=stop).reshape(-1, 2)
        return np.column_stack([rays, np.ones(len(rays))])

    def depth(self, points: Array) -> Array:
        """Return the distance (N,) m of rig points (N, 3) along this camera's optical axis."""
        return points @ self.rotation[2] + self.translation[2]


@dataclass(frozen=True)
class StereoRig:
    """Left and right camera in one frame, the rig frame.

    Raises:
        StereoRefusal: UNCALIBRATED, if both cameras have the same centre (no baseline).
    """

    left: Camera
    right: Camera

    def __post_init__(self) -> None:
        if not self.baseline_m > 1e-6:
            raise StereoRefusal(RefusalReason.UNCALIBRATED, baseline_m=self.baseline_m)

    @property
    def baseline_m(self) -> float:
        return float(np.linalg.norm((self.right.pose - self.left.pose)[:3, 3]))

    @classmethod
    def from_camera_info(cls, left: CameraInfo, right: CameraInfo, *, rectified: bool) -> StereoRig:
        """Make the rig that a pair of CameraInfo messages describes.

        Args:
            rectified: whether the images are rectified (only P is used) or raw (K, D, R and P are).

        Raises:
            StereoRefusal: UNCALIBRATED, if K or P is zero, or P of the right one has no baseline.
            InputError: the distortion model is not known.
        """
        return cls(_from_info(left, rectified), _from_info(right, rectified))


def _from_info(info: CameraInfo, rectified: bool) -> Camera:
    size = (int(info.width), int(info.height))
    p = np.asarray(info.p, dtype=float).reshape(3, 4)
    if not (np.all(np.isfinite(p)) and p[0, 0] > 0.0 and p[1, 1] > 0.0):
        raise StereoRefusal(RefusalReason.UNCALIBRATED, p=p.ravel().tolist())
    shift = np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0])
    if rectified:
        return Camera(p[:, :3], np.eye(3), shift, size)
    check_distortion(info.distortion_model, "camera_info")
    to_camera = np.asarray(info.r, dtype=float).reshape(3, 3).T
    return Camera(info.k, to_camera, to_camera @ shift, size, info.d)
