"""Which poses of a plan may be driven and are seen: keep-out boxes, and what the cameras see."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.arm.parts import Box
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.link_frames import boxes_entered
from longarm_comp.core.model.model import Model

FLOOR = "floor"
"""Name of the keep-out box that is everything below a height."""
_FAR = 1e3
_TIMES = (4, 16, 64)
"""Poses that are drawn for each one that is wanted, where fewer do not give enough."""

Allowed = Callable[[Plan], np.ndarray]
"""(M,) bool: which of M poses may be taken."""


def above(arm: Arm, height_m: float) -> Arm:
    """The arm with a floor at a height (m, base frame) among its keep-out boxes.

    A floor above the arm's foot is a safety height: the arm rises above it once and stays there.
    """
    if not -_FAR < height_m < _FAR:
        raise InputError("floor", "--floor", height_m, f"a height, {-_FAR:g} to {_FAR:g} m")
    floor = Box(min_m=(-_FAR, -_FAR, -_FAR), max_m=(_FAR, _FAR, height_m))
    return arm.model_copy(update={"keep_out": {**arm.keep_out, FLOOR: floor}})


def outside_boxes(model: Model, plan: Plan) -> np.ndarray:
    """(M,) whether the arm stays out of its keep-out boxes, at each pose and where it runs up."""
    if not model.arm.keep_out:
        return np.ones(len(plan), dtype=bool)
    start = plan.q - plan.approach * run_up_lengths(model.arm)
    begun = np.clip(start, model.arm.lower, model.arm.upper)
    pairs = zip(boxes_entered(model, plan.q), boxes_entered(model, begun), strict=True)
    return np.array([not any(pair) for pair in pairs])


def filled(
    make: Callable[[Arm, int, int], Plan], arm: Arm, n: int, seed: int, allowed: Allowed, most: int
) -> Plan:
    """The first n poses that are allowed, of a kind of plan that fills the joint box."""
    free, tried = np.zeros(0, dtype=int), 0
    for count in sorted({n, *(min(times * n, most) for times in _TIMES)}):
        plan = make(arm, count, seed)
        free, tried = np.flatnonzero(allowed(plan))[:n], count
        if len(free) == n:
            return plan if count == n else plan.take(free)
    why = "keep-out boxes, floor and cameras allow no more"
    raise JobError(f"only {len(free)} of {tried} poses are allowed: {why}", asked=n)
