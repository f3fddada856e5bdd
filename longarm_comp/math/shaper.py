"""A motion sent in parts: shares of it, each later than the one before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Way = Callable[[np.ndarray], np.ndarray]
"""Joints (M, n) at times (M,)."""


@dataclass(frozen=True, eq=False)
class Shaper:
    """Parts of every joint's motion: shares (3, n), which add up to 1, and delays (3, n) in s."""

    weights: np.ndarray
    delays: np.ndarray

    @property
    def duration(self) -> float:
        """By how much a motion takes longer, s."""
        return float(self.delays.max(initial=0.0))

    def shaped(self, way: Way) -> Way:
        """The motion in parts; before its time 0 the arm stands still."""

        def at(times: np.ndarray) -> np.ndarray:
            whole = np.zeros((len(times), self.weights.shape[1]))
            for weights, delays in zip(self.weights, self.delays, strict=True):
                for joint, (share, late) in enumerate(zip(weights, delays, strict=True)):
                    whole[:, joint] += share * way(np.maximum(times - late, 0.0))[:, joint]
            return whole

        return at
