"""``longarm study coverage``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--data", "Folder with dlr_justin and wam_ur5; none are judged if absent.")
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    "--arms", type=click.IntRange(min=0), default=6, show_default=True, help="Simulated arms."
)
@click.option(
    "--pandas/--no-pandas", "touched", default=True, help="Six real arms that touched sockets."
)
@options.as_json
def command(data: Path | None, arm: Path | None, arms: int, touched: bool, as_json: bool) -> None:
    """How many rows left out lie inside the 90 % radius that their model states.

    The radius is of a measured row: error of the tip and noise. "kept" says whether it holds, or
    why that cannot be told.

    \b
    Example:
      longarm study coverage --data shared/data/real --arms 6 --json
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import coverage

    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    with progress("study coverage") as show:
        found = [] if data is None else list(coverage.real(data, lambda text: show(text, 0.0)))
        if touched:
            found += coverage.pandas(lambda text: show(text, 0.3))
        found += coverage.simulated(declared, arms, lambda text: show(text, 0.5))
    rows = coverage.table(found)
    if as_json:
        print_json({"rows": rows})
        return
    print_rows("Rows left out inside the stated 90 % radius", rows)
