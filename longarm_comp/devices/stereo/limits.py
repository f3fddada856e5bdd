"""Limits beyond which a stereo pair is refused, and tolerances of the printed marker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.devices.stereo.camera import Array


@dataclass(frozen=True)
class Limits:
    """Limits beyond which a pair is refused.

    Args:
        seen_share: share of the target's corners that both cameras must see (four at least).
        epipolar_px: largest median distance from the epipolar lines.
        rms_px: largest root mean square reprojection error of the whole board.
        edge_px: largest blur (Gaussian sigma of the sharpest edges), px.
        size: largest relative difference of the seen from the declared marker size.
        size_tolerance: tolerance of the printed size (1 sigma, relative). It weighs the depth
            from the size against the depth from the baseline.
    """

    seen_share: float = 0.5
    epipolar_px: float = 1.5
    rms_px: float = 0.8
    edge_px: float = 2.5
    size: float = 0.05
    size_tolerance: float = 0.005

    def tolerance(self, pixels: Array) -> float:
        """Relative 1 sigma of the size measured from an image with corners (N, 2) px.

        Glare, gamma and saturation shift all dark edges alike, by 0.1 px (1 sigma).
        """
        spread = np.sqrt(np.mean(np.sum((pixels - pixels.mean(axis=0)) ** 2, axis=1)))
        return float(np.hypot(self.size_tolerance, np.sqrt(2) * 0.1 / spread))
