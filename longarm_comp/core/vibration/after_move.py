"""The ring that the last move of a running arm leaves, in numbers and in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import modes
from longarm_comp.core.vibration.ring import SMALL_M, along
from longarm_comp.core.vibration.shaper import USUAL_DAMPING
from longarm_comp.math.cubic_path import CubicPath, monotone_slopes


@dataclass(frozen=True)
class MoveRing:
    """What the model expects of the tip after a move.

    Attributes:
        hz: of the slowest mode. size_m: at the end of the move. settle_s: time to rest.
        damping: share of critical damping. declared: whether arm.yaml says it.
    """

    hz: float
    size_m: float
    settle_s: float
    damping: float
    declared: bool

    def said(self) -> str:
        """In one line."""
        told = "" if self.declared else " assumed"
        swing = f"{1e3 * self.size_m:.2g} mm at most, {self.hz:.2g} Hz"
        return (
            f"the tip swings by {swing}; within {1e3 * SMALL_M:g} mm after {self.settle_s:.1f} s "
            f"(damping {self.damping:g}{told})"
        )


def ring_after(
    model: Model, context: Context, start: np.ndarray, points: np.ndarray, times: np.ndarray
) -> MoveRing | None:
    """The ring after a move from rest at ``start`` (n,) through points (k, n) at times (k,) s.

    None where nothing of the model bends.
    """
    found = modes(model, points[-1], context)
    if not len(found.omega):
        return None
    later = times > 0.0
    when, joints = np.append(0.0, times[later]), np.vstack([start, points[later]])
    path = CubicPath(when, joints, monotone_slopes(when, joints))
    damping = model.arm.damping or USUAL_DAMPING
    ring = along(found, path.at, path.duration, damping) if path.duration > 0.0 else None
    size_m, settle_s = (0.0, 0.0) if ring is None else (ring.size_m(), ring.settle_s())
    return MoveRing(float(found.hz[0]), size_m, settle_s, damping, model.arm.damping is not None)
