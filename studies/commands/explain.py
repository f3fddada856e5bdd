"""``longarm study explain``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows


@click.command()
@options.path_option("--arm", "arm.yaml of the declared arm; the demonstration's by default.")
@click.option("--groups", default="none,single,pair", show_default=True)
@click.option("--arms", type=int, default=1, show_default=True, help="Arms like the declared one.")
@click.option("--pairs", type=int, default=12, show_default=True, help="Pairs per arm.")
@click.option("--functions/--no-functions", default=False, show_default=True)
@options.as_json
def command(
    arm: Path | None, groups: str, arms: int, pairs: int, functions: bool, as_json: bool
) -> None:
    """Compare the posterior over explanations with the search, on sessions of 300 rows.

    \b
    Examples:
      longarm study explain
      longarm study explain --groups single --arms 3
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies.explain import compared, summary
    from studies.loop_cases import Design

    design = Design(groups=groups.split(","), rows=(300,), arms=arms, repeats=1, pairs=pairs)
    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    rows = list(compared(design.cases(), declared, functions))
    if as_json:
        print_json({"rows": rows, "summary": summary(rows)})
        return
    print_rows("By case", rows)
    print_rows("In all", summary(rows))
