"""The arm as a polyline, for drawings."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.model.tip_motion import stack


def outline(model: Model, q: np.ndarray, context: Context | None = None) -> np.ndarray:
    """Points (..., k, 3) m, base frame: every station from the foot to the tip, at q (..., n)."""
    posture = model.posture(unstack(q), context)
    points = [stack(frame.p) for frame in (*posture.frames, model.tip_frame(posture))]
    shape = (*np.shape(q)[:-1], 3)
    return np.stack([np.broadcast_to(point, shape) for point in points], axis=-2)


def reach(model: Model) -> tuple[np.ndarray, float]:
    """Where the arm stands (3,), and how far the tip can be from there at most, m.

    It is the length of its outline with every slide driven out.
    """
    arm = model.arm
    line = outline(model, arm.mid)
    slides = [arm.joints[row - 1].type == "prismatic" for row in arm.commanded]
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    return line[0], float(length + (arm.upper - arm.lower)[slides].sum())


def exaggerated(hanging: np.ndarray, declared: np.ndarray, factor: float) -> np.ndarray:
    """Points (k, 3) of an arm whose sag is enlarged by a factor."""
    drawn: np.ndarray = declared + factor * (hanging - declared)
    return drawn
