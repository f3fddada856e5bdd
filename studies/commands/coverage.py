"""``longarm study coverage``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    options.path_option(
        "--data", "Folder with dlr_justin, wam_ur5 or both; none are judged if absent."
    ),
    shape.arm,
    shape.number("--arms", 6, "Simulated arms.", least=0),
    click.option(
        "--pandas/--no-pandas", "touched", default=True, help="Six real arms that touched sockets."
    ),
)
def command(
    data: Path | None, arm: Arm, arms: int, touched: bool, show: shape.Show
) -> shape.Figures:
    """How many rows left out lie inside the 90 % radius that their model states.

    The radius is of a measured row: error of the tip and noise. "kept" says whether it holds, or
    why that cannot be told.

    \b
    Example:
      longarm study coverage --data test/data --arms 6 --json
    """
    from studies import coverage

    found = [] if data is None else list(coverage.real(data, lambda text: show(text, 0.0)))
    if touched:
        found += coverage.pandas(lambda text: show(text, 0.3))
    found += coverage.simulated(arm, arms, lambda text: show(text, 0.5))
    rows = coverage.table(found)
    return shape.Figures({"rows": rows}, {"Rows left out inside the stated 90 % radius": rows})
