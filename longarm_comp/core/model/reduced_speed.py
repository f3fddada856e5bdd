"""Times of a move when the speed limits of the driver are not known: the arm moves slowly."""

import numpy as np

from longarm_comp.core.model.link_frames import most_motion, most_sagging, outline
from longarm_comp.core.model.model import Model

REDUCED_SPEED = 0.25
"""Highest speed of an arm that people may be near, m/s (ISO 10218-1:2011, 5.6.2)."""
_TURNING = 0.5
"""Highest speed of a turning joint, rad/s: a tool that turns about the tip has a size too."""
_PEAK = 1.5
"""Ratio of the highest to the mean speed of a cubic from rest to rest."""
_TIMES = np.linspace(0.0, 1.0, 64 + 1)
_CUBIC = _TIMES**2 * (3.0 - 2.0 * _TIMES)
"""Shares of a way that a cubic from rest to rest has gone at these shares of its time."""


def times_at_reduced_speed(
    model: Model,
    start: np.ndarray,
    points: np.ndarray,
    least_s: float,
    speed: float = REDUCED_SPEED,
) -> np.ndarray:
    """Return the times of way-points at which no part of the arm moves faster than a speed.

    The arm stops at every way-point; between them its joints follow cubics in time.  The speed is
    bounded: of the arm without sag it is computed, and the most that sag adds to it.

    Args:
        start: (n,) joints now, rad and m.
        points: (k, n) way-points.
        least_s: least time from one way-point to the next, s.
        speed: highest speed of a point of the arm's centre-line, m/s.

    Returns:
        (k,) seconds from the start.
    """
    model = model.commandable  # a servo's rounding is no motion on the way
    ends = np.concatenate([start[None], points])
    turns = np.abs(np.diff(ends, axis=0))
    moved = (turns @ most_motion(model).T).max(axis=1)  # it is enough for short moves
    needed = _PEAK * moved / speed
    if (needed > least_s).any():
        ways = ends[:-1, None] + _CUBIC[:, None] * np.diff(ends, axis=0)[:, None]
        line = outline(model.rigid, ways.reshape(-1, len(start))).reshape(*ways.shape[:2], -1, 3)
        steps = np.linalg.norm(np.diff(line, axis=1), axis=-1).max(axis=2)
        steps += np.diff(_CUBIC) * (turns @ most_sagging(model).T).max(axis=1)[:, None]
        needed = steps.max(axis=1) / (_TIMES[1] * speed)
    turned = np.where(model.arm.slides, 0.0, turns).max(axis=1)
    return np.cumsum(np.maximum(least_s, np.maximum(needed, _PEAK * turned / _TURNING)))
