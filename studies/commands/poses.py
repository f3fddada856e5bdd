"""``longarm study poses``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(shape.arm, shape.arms(3), options.seed)
def command(arm: Arm, arms: int, seed: int, show: shape.Show) -> shape.Figures:
    """Error of the true tip after 40, 60, 100, 200 poses by grid, Sobol and I-optimal choice.

    The arms have hidden geometry errors and soft joints, which the calibration knows or has to
    find. Each arm takes a few minutes.

    \b
    Example:
      longarm study poses --arms 3
    """
    from studies import poses

    found: list[poses.PoseOutcome] = []
    steps = arms * len(poses.COUNTS) * len(poses.WAYS) * 2
    for k in range(seed, seed + arms):
        for one in poses.one_arm(arm, k):
            found.append(one)
            show(f"{one.n} poses by {one.way}", len(found) / steps)
    rows = poses.table(found)
    return shape.Figures(
        {"arms": arms, "seed": seed, "rows": rows, "runs": [vars(o) for o in found]},
        {f"Error of the true tip, mean of {arms} arms": rows},
    )
