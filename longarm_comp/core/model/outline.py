"""The arm as a polyline, for drawings."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.model.tip_motion import stack


def outline(model: Model, q: np.ndarray, context: Context | None = None) -> np.ndarray:
    """Points (k, 3) m, base frame: every station of the chain from the foot to the tip, q (n,)."""
    posture = model.posture(unstack(q), context)
    points = [stack(frame.p) for frame in posture.frames]
    return np.array([*points, stack(model.tip_frame(posture).p)])


def exaggerated(hanging: np.ndarray, declared: np.ndarray, factor: float) -> np.ndarray:
    """Points (k, 3) of an arm whose sag is enlarged by a factor."""
    drawn: np.ndarray = declared + factor * (hanging - declared)
    return drawn
