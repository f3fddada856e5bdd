"""A plan of poses as visits in the order to drive them: run-ups, repeats, random order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.data.plan import Plan, with_room
from longarm_comp.core.errors import InputError


@dataclass(frozen=True, eq=False)
class Visit:
    """One measurement to make.

    Attributes:
        path: (k, n) commanded joints to stop at, rad and m: where the last approach begins,
            if it has a side, and the pose to measure.
        repeat_id: number of the pose that is visited more than once, else -1.
        payload_kg: mass to carry, or None for as it is.
    """

    index: int
    path: np.ndarray
    repeat_id: int = -1
    payload_kg: float | None = None

    @property
    def q(self) -> np.ndarray:
        """(n,) joints of the pose to measure, rad and m."""
        return self.path[-1]


def visits(
    plan: Plan, arm: Arm, *, repeats: int = 0, shuffle: bool = True, seed: int = 0
) -> list[Visit]:
    """The visits of a plan; the same arguments always give the same ones, as resuming needs.

    A joint whose planned side has no room at its limit arrives from the other side.

    ``repeats``: this many poses, drawn, come twice more, anywhere in the session. ``shuffle``:
    random order, so that time and pose are not confused.
    """
    if not 0 <= repeats <= len(plan):
        raise InputError("collect", "--repeats", repeats, f"0 to {len(plan)} (poses of the plan)")
    rng = np.random.default_rng(seed)
    again = rng.permutation(len(plan))[:repeats]
    rows = np.concatenate([np.arange(len(plan)), np.repeat(again, 2)])
    order = rng.permutation(len(rows)) if shuffle else np.arange(len(rows))
    first, pose, count = np.unique(
        plan.q[rows], axis=0, return_index=True, return_inverse=True, return_counts=True
    )[1:]
    pose = pose.reshape(-1)
    repeat_id = np.where(count > 1, first, -1)[pose]
    sides = with_room(arm, plan.q, plan.approach)
    start = plan.q - sides * run_up_lengths(arm)
    made = []
    for k, i in enumerate(order):
        row = rows[i]
        path = np.stack([start[row], plan.q[row]] if sides[row].any() else [plan.q[row]])
        payload = None if plan.payload_kg is None else float(plan.payload_kg[row])
        made.append(Visit(k, path, int(repeat_id[i]), payload))
    return made
