"""Times of a move when the speed limits of the driver are not known: the arm moves slowly."""

import numpy as np

from longarm_comp.core.model.link_frames import outline
from longarm_comp.core.model.model import Model

REDUCED_SPEED = 0.25
"""Highest speed of an arm that people may be near, m/s (ISO 10218-1:2011, 5.6.2)."""
_TURNING = 0.5
"""Highest speed of a turning joint, rad/s: a tool that turns about the tip has a size too."""
_PEAK = 1.5
"""Ratio of the highest to the mean speed of a cubic from rest to rest."""
_PIECES = 64
"""Pieces into which a motion is divided to measure its length."""


def times_at_reduced_speed(
    model: Model,
    start: np.ndarray,
    points: np.ndarray,
    least_s: float,
    speed: float = REDUCED_SPEED,
) -> np.ndarray:
    """Return the times of way-points at which no part of the arm moves faster than a speed.

    The arm stops at every way-point; between them its joints follow cubics in time.

    Args:
        start: (n,) joints now, rad and m.
        points: (k, n) way-points.
        least_s: least time from one way-point to the next, s.
        speed: highest speed of a point of the arm's centre-line, m/s.

    Returns:
        (k,) seconds from the start.
    """
    ends = np.concatenate([start[None], points])
    ways = np.linspace(ends[:-1], ends[1:], _PIECES + 1, axis=1)
    line = outline(model, ways.reshape(-1, len(start))).reshape(*ways.shape[:2], -1, 3)
    moved = _PIECES * np.linalg.norm(np.diff(line, axis=1), axis=-1).max(axis=(1, 2), initial=0.0)
    turned = np.abs(np.where(model.arm.slides, 0.0, np.diff(ends, axis=0))).max(axis=1)
    return np.cumsum(np.maximum(least_s, _PEAK * np.maximum(moved / speed, turned / _TURNING)))
