"""What the data cannot tell of what was found, and poses that would."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.quantities import JointPosition, OfPosture
from longarm_comp.core.effects.shapes import Shape, Switch
from longarm_comp.core.identify.discover.inputs import FEW_LEVELS, levels_of
from longarm_comp.core.identify.discover.words import Found
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.next_poses import POOL
from longarm_comp.core.model.model import unstack

POSES = 6
"""Poses for each doubt."""


def doubts(fit: ModelFit, found: Sequence[Found]) -> tuple[str, ...]:
    """Joints that were measured at few positions, and thresholds that lie in a gap of the data."""
    made = []
    for shape in _shapes(found):
        if _on_few(fit, shape):
            made.append(f"{shape.of} was measured at few positions; between them it is a guess")
        if isinstance(shape, Switch):
            low, high = shape.threshold - shape.half, shape.threshold + shape.half
            made.append(f"it changes somewhere between {shape.of} {low:.4g} and {high:.4g}")
    return tuple(dict.fromkeys(made))


def proposed(fit: ModelFit, found: Sequence[Found], seed: int) -> np.ndarray:
    """(M, n) poses that would settle the doubts, rad and m; none where there are none."""
    from scipy.stats import qmc  # takes a quarter of a second

    arm = fit.model.arm
    pool = arm.lower + (arm.upper - arm.lower) * qmc.Sobol(arm.n, seed=seed).random(POOL)
    recorded = fit.session.columns
    usual = Context(columns={k: np.full(POOL, float(np.median(v))) for k, v in recorded.items()})
    posture = fit.model.posture(unstack(pool), usual)
    chosen: list[int] = []
    for shape in _shapes(found):
        if isinstance(shape, Switch) and isinstance(shape.quantity, OfPosture):
            away = np.abs(np.asarray(shape.quantity.read(posture)) - shape.threshold)
            chosen += np.argsort(away + np.zeros(POOL), kind="stable")[:POSES].tolist()
        elif _on_few(fit, shape):
            chosen += range(POSES)
    return np.asarray(pool[list(dict.fromkeys(chosen))])


def _shapes(found: Sequence[Found]) -> list[Shape]:
    return list(dict.fromkeys(s for t in found for s in t.of.factors))


def _on_few(fit: ModelFit, shape: Shape) -> bool:
    of = shape.quantity
    if not isinstance(of, JointPosition):
        return False
    return levels_of(fit.session.q[:, of.joint]) <= FEW_LEVELS
