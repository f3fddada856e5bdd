"""A shaped motion: the weighted sum of delayed copies of it, some of them stretched in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Way = Callable[[np.ndarray], np.ndarray]
"""Joints (M, n) at times (M,)."""


@dataclass(frozen=True, eq=False)
class Shaper:
    """Parts of a motion that takes some seconds from time 0 on.

    Attributes:
        weights: (P,) shares above 0, which add up to 1.
        begins, ends: (P,) s: by how much later a part begins and ends than the motion. None ends
            less late than it begins: no part is faster than the motion.
    """

    weights: np.ndarray
    begins: np.ndarray
    ends: np.ndarray

    @property
    def duration(self) -> float:
        """The time by which a motion takes longer, s."""
        return float(self.ends.max(initial=0.0))

    def since(self, times: np.ndarray, seconds: float) -> np.ndarray:
        """Return (P, M) s: what times of a motion of some seconds its parts reached at (M,) s."""
        pace = seconds / (seconds + self.ends - self.begins)
        since = np.subtract.outer(times, self.begins) * pace
        return np.asarray(np.clip(since, 0.0, seconds).T)

    def parts(self, way: Way, times: np.ndarray, seconds: float) -> np.ndarray:
        """Return (P, M, n) rad and m: the joints of every part at times (M,) s."""
        since = self.since(times, seconds)
        return way(since.ravel()).reshape(*since.shape, -1)

    def shape_motion(self, way: Way, seconds: float) -> Way:
        """Return the motion in parts; before its time 0 the arm stands still."""
        return lambda times: np.tensordot(self.weights, self.parts(way, times, seconds), 1)
