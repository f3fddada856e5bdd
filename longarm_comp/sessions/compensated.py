"""Targets of a file through compensation to the lines of commands.csv."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.compensation.compensate import compensate_many
from longarm_comp.core.compensation.result import Compensation, ErrorPredictor
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.targets import Command, Targets


def compensated(
    model: Model, predictor: ErrorPredictor | None, targets: Targets, **options: Any
) -> list[Command]:
    """A command per target, in their order; options as in `compensate_many`.

    Targets with an orientation are poses, the others positions.
    """
    posed = ~np.isnan(targets.quaternion[:, 0])
    context = targets.context(model.arm.n)
    made: dict[int, Command] = {}
    for rows in (np.flatnonzero(posed), np.flatnonzero(~posed)):
        if not rows.size:
            continue
        goals = targets.xyz[rows]
        if posed[rows[0]]:
            goals = np.tile(np.eye(4), (len(rows), 1, 1))
            goals[:, :3, :3] = Rotation.from_quat(targets.quaternion[rows]).as_matrix()
            goals[:, :3, 3] = targets.xyz[rows]
        stories = compensate_many(model, predictor, goals, context=context.take(rows), **options)
        for k, row in enumerate(rows.tolist()):
            made[row] = _command(targets, row, stories[k])
    return [made[row] for row in range(len(targets))]


def _command(targets: Targets, row: int, story: Compensation) -> Command:
    sigma = float(np.max(story.sigma))
    return Command(
        index=int(targets.index[row]),
        status=story.status.name.lower(),
        reason=story.reason,
        q=story.command if story.success else None,
        target=targets.xyz[row],
        predicted_error=story.predicted_error if np.isfinite(sigma) else None,
        sigma_m=sigma if np.isfinite(sigma) else None,
        passes=story.passes,
    )
