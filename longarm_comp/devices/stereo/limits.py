"""When a stereo pair is refused, and how much its marker's printed size is trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.devices.stereo.camera import Array


@dataclass(frozen=True)
class Limits:
    """When a pair is refused.

    Args:
        seen_share: share of the target's corners that both cameras must see (four at least).
        epipolar_px: largest median distance from the epipolar lines.
        rms_px: largest root mean square reprojection error of the whole board.
        edge_px: largest blur (Gaussian sigma of the sharpest edges), px.
        bright: grey level that 99 % of the pixels must not stay below, when no marker is found.
        dark: grey level that 1 % of the pixels must stay below, when no marker is found.
        size: largest relative difference of the seen from the declared marker size.
        size_tolerance: how well the print's size is known (1 sigma, relative); it ties the depth
            from the baseline to the depth from the size.
        edge_bias_px: how far glare, gamma and saturation may move every dark edge the same way
            (1 sigma); it makes small images of the marker tell less by their size.
    """

    seen_share: float = 0.5
    epipolar_px: float = 1.5
    rms_px: float = 0.8
    edge_px: float = 2.5
    bright: float = 45.0
    dark: float = 235.0
    size: float = 0.05
    size_tolerance: float = 0.005
    edge_bias_px: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 <= self.seen_share <= 1.0:
            raise InputError("stereo limits", "seen_share", self.seen_share, "0 to 1")
        if not self.edge_bias_px >= 0.0:
            raise InputError("stereo limits", "edge_bias_px", self.edge_bias_px, "0 or more")
        for name in ("epipolar_px", "rms_px", "edge_px", "size", "size_tolerance"):
            if not getattr(self, name) > 0.0:
                raise InputError("stereo limits", name, getattr(self, name), "more than 0")

    def tolerance(self, pixels: Array) -> float:
        """1 sigma of what the size of an image with corners (N, 2) px says about size, relative."""
        spread = np.sqrt(np.mean(np.sum((pixels - pixels.mean(axis=0)) ** 2, axis=1)))
        return float(np.hypot(self.size_tolerance, np.sqrt(2) * self.edge_bias_px / spread))
