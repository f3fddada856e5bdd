"""Exposure and sharpness of an image, to explain why no marker was found."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from longarm_comp.devices.stereo.camera import Array

_PRESMOOTH_PX = 1.0


@dataclass(frozen=True)
class ImageQuality:
    """Grey levels that 1 % and 99 % of the pixels stay below, and the sharpest edge's sigma, px."""

    dark: float
    bright: float
    edge_px: float


def image_quality(grey: NDArray[np.uint8]) -> ImageQuality:
    """Exposure and sharpness of an image (H, W).

    A step of height H blurred by a Gaussian of s px has the steepest slope ``H / (s sqrt(2 pi))``;
    read backwards, the image's steepest slopes and its range of grey give s. The image is smoothed
    by 1 px first, against noise, which is taken out again.
    """
    dark, bright = np.percentile(grey[::2, ::2], [1.0, 99.0])
    return ImageQuality(float(dark), float(bright), _edge_px(grey, float(bright - dark)))


def edge_sigma_px(grey: NDArray[np.uint8], pixels: Array) -> float:
    """Sigma (px) of the sharpest edges inside the box around a marker's corners (N, 2)."""
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 4, 0)
    high = np.ceil(pixels.max(axis=0)).astype(int) + 5
    patch = grey[low[1] : high[1], low[0] : high[0]]
    dark, bright = np.percentile(patch, [5.0, 95.0])
    return _edge_px(patch, float(bright - dark))


def _edge_px(grey: NDArray[np.uint8], height: float) -> float:
    smooth = cv2.GaussianBlur(grey, (0, 0), _PRESMOOTH_PX).astype(np.float32)
    slope = cv2.magnitude(
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    steepest = float(
        np.partition(slope.ravel(), -max(slope.size // 500, 1))[-max(slope.size // 500, 1)]
    )
    total = height / (steepest * np.sqrt(2 * np.pi)) if steepest > 0.0 else np.inf
    return float(np.sqrt(max(total**2 - _PRESMOOTH_PX**2, 0.0)))
