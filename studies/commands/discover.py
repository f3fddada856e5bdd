"""``longarm study discover``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    shape.arm,
    click.option("--case", "chosen", multiple=True, help="Case; repeat for more. Default: all."),
    click.option(
        "--plan", "plans", multiple=True, type=click.Choice(["grid", "sobol"]), default=("grid",),
        show_default=True, help="Poses that are measured; repeat for both.",
    ),
    shape.number("--seeds", 1, "Seeds of each case."),
    click.option("--no-network", is_flag=True, help="Leave out the network."),
    options.seed,
)  # fmt: skip
def command(
    arm: Arm, chosen: tuple[str, ...], plans: tuple[str, ...], seeds: int, no_network: bool,
    seed: int, show: shape.Show,
) -> shape.Figures:  # fmt: skip
    """Hide causes that are in no library, and print the error left by each method.

    Errors are rms in mm against the truth without noise: on fresh poses of the plan that was
    measured, and at random poses off it. "nothing" hides nothing.

    \b
    Example:
      longarm study discover --case hose_pull --case nothing
    """
    from longarm_comp.core.errors import InputError
    from studies import discover
    from studies.outside import outside

    known = (*outside(arm), discover.NOTHING)
    for case in chosen:
        if case not in known:
            raise InputError("study discover", "case", case, ", ".join(known))
    cases = chosen or known
    total = len(cases) * len(plans) * seeds
    rows = []
    for one in discover.study(arm, cases, plans, range(seed, seed + seeds), not no_network):
        rows.append(one)
        show(f"{one['case']} {one['plan']}", len(rows) / total)
    return shape.Figures({"rows": rows}, {"Errors against the truth, on the plan / off it": rows})
