"""Finds a target's corners in one image, or refuses the image with a reason."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.devices.stereo.camera import Array
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import Corners, Grey, Target


@dataclass(frozen=True)
class Limits:
    """Limits beyond which a pair of images is refused."""

    seen_share: float = 0.5
    """Share of the target's corners that both cameras must see (four at least)."""
    epipolar_px: float = 1.5  # largest median distance from the epipolar lines
    rms_px: float = 0.8  # largest root mean square reprojection error of the whole board
    edge_px: float = 2.5  # largest blur (Gaussian sigma of the sharpest edges), px
    size: float = 0.05  # largest relative difference of the seen from the declared marker size
    size_tolerance: float = 0.005
    """Tolerance of the printed size (1 sigma, relative). It decides how much the depth from the
    marker's size counts beside the depth from the baseline."""

    def tolerance(self, pixels: Array) -> float:
        """Return the tolerance (1 sigma, relative) of the size of a marker with corners (N, 2), px.

        To the printed size it adds that glare, gamma and saturation shift all dark edges alike, by
        0.1 px (1 sigma).
        """
        spread = np.sqrt(np.mean(np.sum((pixels - pixels.mean(axis=0)) ** 2, axis=1)))
        return float(np.hypot(self.size_tolerance, np.sqrt(2) * 0.1 / spread))


_PRESMOOTH_PX = 1.0
"""Gaussian sigma, px, of smoothing against pixel noise; about the blur of a sharp lens."""


def _edge_px(grey: NDArray[np.uint8], height: float) -> float:
    """Estimate the blur, Gaussian sigma in px, of the sharpest edges of an image (H, W).

    A step of `height` grey levels, blurred by a Gaussian of s px, has the steepest slope
    ``height / (s sqrt(2 pi))``. So s follows from the steepest slopes. The image is first smoothed
    by 1 px against noise; this blur is subtracted from the result.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _PRESMOOTH_PX).astype(np.float32)
    slope = cv2.magnitude(
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    sharp = max(slope.size // 500, 1)
    steepest = float(np.partition(slope.ravel(), -sharp)[-sharp])
    total = height / (steepest * np.sqrt(2 * np.pi)) if steepest > 0.0 else np.inf
    return float(np.sqrt(max(total**2 - _PRESMOOTH_PX**2, 0.0)))


def find_corners(target: Target, grey: Grey, side: str, limits: Limits) -> Corners:
    """Find the corners of a target in the image (H, W) of the ``left`` or the ``right`` camera.

    Raises:
        StereoRefusal: AMBIGUOUS or BLURRED; TOO_DARK, TOO_BRIGHT, BLURRED or NOT_FOUND_... if no
            corner is found.
    """
    seen = target.detect(grey)
    if seen.repeated:
        raise StereoRefusal(RefusalReason.AMBIGUOUS, image=side, ids=seen.repeated)
    if not len(seen):
        raise _make_refusal(grey, side, limits)
    low = np.maximum(np.floor(seen.pixels.min(axis=0)).astype(int) - 4, 0)
    high = np.ceil(seen.pixels.max(axis=0)).astype(int) + 5
    patch = grey[low[1] : high[1], low[0] : high[0]]
    blur = _edge_px(patch, float(np.ptp(np.percentile(patch, [5.0, 95.0]))))
    if not blur <= limits.edge_px:
        raise StereoRefusal(RefusalReason.BLURRED, image=side, edge_px=round(blur, 2))
    return seen


def _make_refusal(grey: Grey, side: str, limits: Limits) -> StereoRefusal:
    dark, bright = np.percentile(grey[::2, ::2], [1.0, 99.0])
    facts: dict[str, object] = {"image": side, "bright": round(bright), "dark": round(dark)}
    if not bright >= 45.0:
        return StereoRefusal(RefusalReason.TOO_DARK, **facts)
    if not dark <= 235.0:
        return StereoRefusal(RefusalReason.TOO_BRIGHT, **facts)
    edge_px = _edge_px(grey, float(bright - dark))
    facts["edge_px"] = round(edge_px, 2)
    if not edge_px <= limits.edge_px:
        return StereoRefusal(RefusalReason.BLURRED, **facts)
    return StereoRefusal(RefusalReason[f"NOT_FOUND_{side.upper()}"], **facts)
