"""``longarm study poses``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=3, show_default=True,
    help="Simulated arms, with other hidden errors each.",
)  # fmt: skip
@options.seed
@options.as_json
def command(arm: Path | None, count: int, seed: int, as_json: bool) -> None:
    """Error of the true tip after 40, 60, 100, 200 poses by grid, Sobol and I-optimal choice.

    The arms hide geometry errors and compliant joints, which the calibration is told of or has to
    find. Each arm takes a few minutes.

    \b
    Example:
      longarm study poses --arms 3
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import poses

    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    found: list[poses.PoseOutcome] = []
    steps = count * len(poses.COUNTS) * len(poses.WAYS) * 2
    with progress("study poses") as show:
        for k in range(seed, seed + count):
            for one in poses.one_arm(declared, k):
                found.append(one)
                show(f"{one.n} poses by {one.way}", len(found) / steps)
    rows = poses.table(found)
    if as_json:
        print_json({"arms": count, "seed": seed, "rows": rows, "runs": [vars(o) for o in found]})
        return
    print_rows(f"Error of the true tip, mean of {count} arms", rows)
