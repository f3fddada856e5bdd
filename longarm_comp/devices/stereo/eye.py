"""Measures the tip in the base frame from a stereo pair, or refuses the pair with a reason."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.devices.stereo.camera import Array, Camera, StereoRig
from longarm_comp.devices.stereo.found import Limits, find_corners
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import Grey, Target, on_one_line
from longarm_comp.devices.stereo.triangulate import (
    PixelNoise,
    epipolar_px,
    marker_pose,
    rms,
    triangulate,
)

_KEPT = 1.0 - 1.0 / 200.0  # forgetting factor of residuals: about the last 200 sightings count


@dataclass(frozen=True)
class StereoSighting:
    point: Array  # (3,) m, tip in the base frame
    pose: Array  # (4, 4) marker in the base frame
    pose_covariance: Array  # (6, 6) of ``[tip; rotation]`` along the base axes, m and rad
    corners: int  # corners that both cameras saw
    rms_px: float  # root mean square reprojection error
    scale: float  # seen / declared marker size (with the declared size as a prior)


@dataclass
class StereoEye:
    rig: StereoRig
    target: Target
    camera_in_base: ArrayLike = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the left optical frame in the base frame (hand-eye)."""
    tip_in_marker: ArrayLike = (0.0, 0.0, 0.0)  # (3,) m, the tip in the marker frame
    limits: Limits = field(default_factory=Limits)
    noise: PixelNoise = field(default_factory=PixelNoise)
    """Assumed noise of a corner, corrected by the residuals of sightings."""

    def __post_init__(self) -> None:
        self._square_px2 = self._freedom = 0.0
        self._hand_eye = np.asarray(self.camera_in_base, dtype=float)
        self._tip = np.asarray(self.tip_in_marker, dtype=float)

    def measure(self, left: Grey, right: Grey) -> StereoSighting:
        """Measure the tip in one pair of images, (H, W) grey or (H, W, 3) BGR, uint8.

        Raises:
            StereoRefusal: the pair gives no measurement; its `reason` says why.
        """
        try:
            return self._measure_pair(left, right)
        except np.linalg.LinAlgError as error:  # rays so nearly parallel that nothing can be solved
            raise StereoRefusal(RefusalReason.REPROJECTION, cause=str(error)) from error

    @property
    def cameras(self) -> tuple[Array, Array]:
        """Pose (4, 4) of the left and of the right optical frame in the base frame."""
        left, right = (self._hand_eye @ camera.pose for camera in (self.rig.left, self.rig.right))
        return left, right

    @property
    def expected_noise(self) -> PixelNoise:
        """The assumed noise, corrected by the residuals of the last sightings, not of one only."""
        sigma_px = self.noise.estimate(np.sqrt(self._square_px2), self._freedom)
        return PixelNoise(sigma_px, self.noise.weight)

    def _measure_pair(self, left: Grey, right: Grey) -> StereoSighting:
        greys = _as_grey(left, self.rig.left, "left"), _as_grey(right, self.rig.right, "right")
        in_left = find_corners(self.target, greys[0], "left", self.limits)
        in_right = find_corners(self.target, greys[1], "right", self.limits)
        ids, left_px, right_px = in_left.shared_corners(in_right)
        corners = self.target.points(ids)
        fewest = max(4, int(np.ceil(self.limits.seen_share * self.target.n_corners)))
        if len(ids) < fewest or on_one_line(corners):
            raise StereoRefusal(RefusalReason.OCCLUDED, corners=len(ids), of=self.target.n_corners)
        off = float(np.median(epipolar_px(self.rig, left_px, right_px)))
        if not off <= self.limits.epipolar_px:
            raise StereoRefusal(RefusalReason.EPIPOLAR, epipolar_px=round(off, 3))
        points, _ = triangulate(self.rig, left_px, right_px)
        spread = [np.linalg.norm(p - p.mean(axis=0)) for p in (points, corners)]
        size = float(spread[0] / spread[1])
        if abs(size - 1.0) > self.limits.size:
            raise StereoRefusal(RefusalReason.MARKER_SIZE, seen_over_declared=round(size, 4))
        tolerance, noise = self.limits.tolerance(left_px), self.expected_noise
        pose = marker_pose(self.rig, corners, points, left_px, right_px, tolerance, noise)
        rms_px = rms(pose.residuals)
        if not rms_px <= self.limits.rms_px:
            raise StereoRefusal(RefusalReason.REPROJECTION, rms_px=round(rms_px, 3))
        self._square_px2 = _KEPT * self._square_px2 + float(np.sum(np.square(pose.residuals)))
        self._freedom = _KEPT * self._freedom + pose.residuals.size - 6
        point, covariance = pose.at(self._tip)
        turn = self._hand_eye[:3, :3]
        turns = np.kron(np.eye(2), turn)
        return StereoSighting(
            point=turn @ point + self._hand_eye[:3, 3],
            pose=self._hand_eye @ pose.transform,
            pose_covariance=turns @ covariance @ turns.T,
            corners=len(ids),
            rms_px=rms_px,
            scale=pose.scale,
        )


def _as_grey(image: Grey, camera: Camera, side: str) -> Grey:
    """Return an image as grey (H, W). Raises StereoRefusal (WRONG_SIZE) for another size."""
    height, width = image.shape[:2]
    if (width, height) != camera.size:
        size = f"{width}x{height}"
        allowed = f"{camera.size[0]}x{camera.size[1]}"
        raise StereoRefusal(RefusalReason.WRONG_SIZE, image=side, size=size, calibrated=allowed)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(grey)
