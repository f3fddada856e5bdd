"""A plan of poses as visits in the order to drive them: both sides, repeats, random order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import Plan
from longarm_comp.core.errors import InputError

RUN_UP = 0.06
"""Way of the last approach, as a share of each joint's range: longer than any play."""


@dataclass(frozen=True, eq=False)
class Visit:
    """One measurement to make.

    Attributes:
        index: its number in the session.
        q: (n,) commanded joints, rad and m.
        via: (n,) where the last approach begins; None: straight from where the arm is.
        repeat_id: number of the pose that is visited more than once, else -1.
        payload_kg: mass to carry, or None for as it is.
    """

    index: int
    q: np.ndarray
    via: np.ndarray | None
    repeat_id: int = -1
    payload_kg: float | None = None


def visits(
    plan: Plan,
    arm: Arm,
    *,
    both_sides: bool = False,
    repeats: int = 0,
    shuffle: bool = True,
    seed: int = 0,
) -> list[Visit]:
    """The visits of a plan; the same arguments always give the same ones, as resuming needs.

    Args:
        both_sides: every pose twice, from below and from above.
        repeats: this many poses, drawn, come twice more, anywhere in the session.
        shuffle: random order, so that time and pose are not confused.
        seed: of the drawing and the order.

    Raises:
        InputError: more repeats than poses.
    """
    if not 0 <= repeats <= len(plan):
        raise InputError("collect", "--repeats", repeats, f"0 to {len(plan)} (poses of the plan)")
    rng = np.random.default_rng(seed)
    sides = [(-1, 1)] * len(plan) if both_sides else [(int(side),) for side in plan.approach]
    made = [(pose, side) for pose in range(len(plan)) for side in sides[pose]]
    again = rng.permutation(len(plan))[:repeats]
    made += [(int(pose), sides[pose][0]) for pose in again for _ in range(2)]
    order = rng.permutation(len(made)) if shuffle else np.arange(len(made))
    poses = [pose for pose, _ in made]
    return [
        _visit(plan, arm, k, *made[i], repeated=poses.count(made[i][0]) > 1)
        for k, i in enumerate(order)
    ]


def _visit(plan: Plan, arm: Arm, index: int, pose: int, side: int, *, repeated: bool) -> Visit:
    q = plan.q[pose]
    via = None
    if side:
        via = np.clip(q - side * RUN_UP * (arm.upper - arm.lower), arm.lower, arm.upper)
    payload = None if plan.payload_kg is None else float(plan.payload_kg[pose])
    return Visit(index, q, via, pose if repeated else -1, payload)
