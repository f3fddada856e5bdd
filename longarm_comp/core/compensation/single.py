"""One target, written out plainly: what `compensate_many` does for N at once.

On the running arm every tenth of a millisecond counts, and masks over one row cost many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.result import (
    NO_PREDICTOR,
    Compensation,
    Prediction,
    Predictor,
    Settling,
    Status,
    missed,
    outside,
    predictor_context,
    shifted,
)
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.model import Model

NEARBY_STARTS = 3
"""A pseudo-target lies next to its target: look near its joints only."""


@dataclass(frozen=True)
class Task:
    """How to reach a target.

    Attributes:
        model: the physics that the method uses.
        predictor: the learned residual that it uses, or None; learned: whether it uses one.
        position_only, locked: as in `ik.solve`.
        settling: when the passes end.
    """

    model: Model
    predictor: Predictor | None
    learned: bool
    context: Context
    position_only: bool
    locked: tuple[int | str, ...]
    settling: Settling


def compensate_one(task: Task, target: np.ndarray, seed: np.ndarray | None) -> Compensation:
    """The story of one target, (3,) or (4, 4); seed (n,)."""
    ideal = q = ik.checked_seed(task.model, seed, 1, "compensate")[0]
    error, sigma = np.zeros(3), np.full(3, np.nan)
    inside, passes = False, 0

    def told(status: Status, reason: str = "") -> Compensation:
        applied = np.zeros(3) if status.physics_only else error
        command = q if status is Status.SUCCESS else ideal
        pseudo = shifted(target, applied)
        return Compensation(
            target, ideal, applied, sigma, inside, pseudo, command, passes, status, reason
        )

    def search(to: np.ndarray, starts: int) -> ik.Solution:
        return ik.solve(
            task.model, to, seed=q, context=task.context, position_only=task.position_only,
            locked=task.locked, max_starts=starts,
        )  # fmt: skip

    fault = ik.target_faults(target[None], task.position_only, "compensate")[0]
    if fault:
        return told(Status.BAD_TARGET, fault)
    found = search(target, ik.MAX_STARTS)
    ideal = q = found.q
    if not found.ok:
        return told(Status.UNREACHABLE, missed("target", found))
    if not task.learned:
        return told(Status.SUCCESS)
    if task.predictor is None:
        return told(Status.NO_PREDICTOR, NO_PREDICTOR)
    columns, settling = predictor_context(task.context, 1), task.settling
    while True:
        expected = task.predictor.predict(q[None], columns)
        before, error, sigma = error, np.asarray(expected.error[0], float), expected.sigma[0]
        size = math.sqrt(error @ error)
        inside = bool(expected.in_domain[0]) and math.isfinite(size)
        if not inside:
            return told(Status.OUT_OF_DOMAIN, outside(_reason(expected)))
        if size > settling.max_correction_m:
            return told(Status.CORRECTION_TOO_LARGE, settling.too_large(size))
        if passes and math.dist(error, before) <= settling.tol_m:
            return told(Status.SUCCESS)
        if passes == settling.max_passes:
            return told(Status.NOT_CONVERGED, settling.unsettled)
        passes += 1
        found = search(shifted(target, error), NEARBY_STARTS)
        if not found.ok:
            return told(Status.UNREACHABLE, missed("pseudo-target", found))
        q = found.q
        if settling.single_pass:
            return told(Status.SUCCESS)


def _reason(prediction: Prediction) -> str:
    texts = getattr(prediction, "reason", None)
    return str(texts[0]) if texts else ""
