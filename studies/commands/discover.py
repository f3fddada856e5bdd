"""``longarm study discover``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option("--case", "chosen", multiple=True, help="Case; repeat for more. Default: all.")
@click.option(
    "--plan", "plans", multiple=True, type=click.Choice(["grid", "sobol"]), default=("grid",),
    show_default=True, help="Poses that are measured; repeat for both.",
)  # fmt: skip
@click.option(
    *("--seeds", "count"), type=click.IntRange(min=1), default=1, show_default=True,
    help="Seeds of each case.",
)  # fmt: skip
@click.option("--no-network", is_flag=True, help="Leave out the network.")
@options.seed
@options.as_json
def command(
    arm: Path | None,
    chosen: tuple[str, ...],
    plans: tuple[str, ...],
    count: int,
    no_network: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Causes in no library: what calibration, library, discovery and learning leave of them.

    Errors are rms in mm against the truth without noise: on fresh poses of the plan that was
    measured, and at random poses off it. "nothing" hides nothing.

    \b
    Example:
      longarm study discover --case hose_pull --case nothing
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.errors import InputError
    from longarm_comp.share import folder
    from longarm_comp.sim.hidden.outside import outside
    from studies import discover

    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    known = (*outside(declared), discover.NOTHING)
    for case in chosen:
        if case not in known:
            raise InputError("study discover", "case", case, ", ".join(known))
    cases = chosen or known
    seeds = range(seed, seed + count)
    total = len(cases) * len(plans) * count
    rows = []
    with progress("study discover") as show:
        for one in discover.study(declared, cases, plans, seeds, not no_network):
            rows.append(one)
            show(f"{one['case']} {one['plan']}", len(rows) / total)
    if as_json:
        print_json({"rows": rows})
        return
    print_rows("Errors against the truth, on the plan / off it", rows)
