"""The poses that a round of the loop measures."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from longarm_comp.core.data.plan import Plan, fill_plan, outside_boxes, sobol
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.collect.load import find_carried
from longarm_comp.sessions.poses import read_poses

_MOST_DRAWN = 2**20


def plan_round(
    client: ArmClient, count: int, seed: int, asked: Path | None
) -> tuple[Plan, dict[str, int]]:
    """Return poses outside the keep-out boxes, first those of a file that a diagnosis wrote.

    The loop asks nobody for another payload: poses with one are left out.

    Args:
        count: number of poses; poses that fill the joint box follow those of the file.
        asked: the file, if there is one; it need not exist.

    Returns:
        The plan, and the number of poses of the file that were left out, by reason.
    """
    arm = client.arm
    free: Callable[[Plan], np.ndarray] = partial(outside_boxes, declared_model(arm))
    plan, left_out = fill_plan(sobol, arm, count, seed, free, _MOST_DRAWN), {}
    if asked is not None and asked.is_file():
        wanted = read_poses(asked, arm)
        outside, carried = free(wanted), np.ones(len(wanted), bool)
        if wanted.payload_kg is not None:
            carried = find_carried(client, wanted.payload_kg)
        left_out = {
            "asked for in a keep-out box": int((~outside).sum()),
            "asked for with another payload": int((outside & ~carried).sum()),
        }
        wanted = wanted.take(np.flatnonzero(outside & carried))
        more = max(0, count - len(wanted))
        plan = Plan(
            np.concatenate([wanted.q, plan.q[:more]]),
            np.concatenate([wanted.approach, plan.approach[:more]]),
        )
    return plan, {why: number for why, number in left_out.items() if number}
