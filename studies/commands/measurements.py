"""``longarm study measurements``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=5, show_default=True,
    help="Simulated arms, with other hidden errors each.",
)  # fmt: skip
@options.seed
@options.as_json
def command(arm: Path | None, count: int, seed: int, as_json: bool) -> None:
    """Rows that a calibration needs where a row is a pose, a position, one distance, or a touch.

    Errors are of the true tip at poses that were not measured.

    \b
    Example:
      longarm study measurements --arms 5
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import measurements

    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    counts, limits = measurements.ROWS, (1e-3, 5e-4, 2.5e-4)
    found = []
    with progress("study measurements") as show:
        for one in measurements.study(declared, range(seed, seed + count)):
            found.append(one)
            show(f"{len(found)} of {count} arms", len(found) / count)
    rows = measurements.table(found, counts)
    needed = measurements.needed(found, counts, limits)
    if as_json:
        print_json({"arms": count, "seed": seed, "errors": rows, "needed": needed})
        return
    print_rows(f"Error of the true tip, median of {count} arms", rows)
    print_rows("Rows needed", needed)
