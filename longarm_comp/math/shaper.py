"""A shaped motion: the weighted sum of delayed copies of it, some of them stretched in time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Way = Callable[[np.ndarray], np.ndarray]
"""Joints (M, n) at times (M,)."""


@dataclass(frozen=True, eq=False)
class Shaper:
    """The parts (delayed, stretched copies) of a motion that begins at time 0."""

    weights: np.ndarray  # (P,) shares of the parts, none negative; they add up to 1
    begins: np.ndarray  # (P,) s, delay of the beginning of each part
    ends: np.ndarray  # (P,) s, of its end, at least as much: no part is faster than the motion

    @property
    def duration(self) -> float:
        """The time (s) by which a shaped motion takes longer."""
        return float(self.ends.max(initial=0.0))

    def since(self, times: np.ndarray, seconds: float) -> np.ndarray:
        """Return (P, M), s: the time that each part of a motion of `seconds` has reached."""
        pace = seconds / (seconds + self.ends - self.begins)
        since = np.subtract.outer(times, self.begins) * pace
        return np.asarray(np.clip(since, 0.0, seconds).T)

    def parts(self, way: Way, times: np.ndarray, seconds: float) -> np.ndarray:
        """Return the joints (P, M, n), rad and m, of every part at times (M,), s."""
        since = self.since(times, seconds)
        return way(since.ravel()).reshape(*since.shape, -1)

    def shape_motion(self, way: Way, seconds: float) -> Way:
        """Return the shaped motion: the weighted sum of its parts; still before time 0."""
        return lambda times: np.tensordot(self.weights, self.parts(way, times, seconds), 1)
