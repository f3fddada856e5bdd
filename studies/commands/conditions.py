"""``longarm study conditions``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=8, show_default=True,
    help="Simulated arms.",
)  # fmt: skip
@options.seed
@options.as_json
def command(arm: Path | None, count: int, seed: int, as_json: bool) -> None:
    """Train in one condition, command in another: payload, temperature, wear.

    The paper's claim S14: error model and network together lose less than the network alone.
    About a minute an arm.

    \b
    Example:
      longarm study conditions --arms 8
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import conditions

    base = Arm.load(arm or folder("config") / "arm_demo.yaml")
    settings, arms = conditions.rows_of(), []
    with progress("study conditions") as show:
        for number in range(count):
            show(f"arm {number + 1} of {count}", number / count)
            arms.append(conditions.one_arm(base, seed, number, settings))
    rows, claims = conditions.table(arms, settings), conditions.claims(arms, settings)
    if as_json:
        print_json({"arms": count, "rows": rows, "claims": claims})
        return
    print_rows(f"Mean errors of the true tip, trained as in the first column: {count} arms", rows)
    print_rows(
        "S14: what another condition costs",
        [
            {k: v for k, v in line.items() if k != "ci95_mm"}
            | {"ci95 low": line["ci95_mm"][0], "high": line["ci95_mm"][1]}
            for line in claims
        ],
    )
