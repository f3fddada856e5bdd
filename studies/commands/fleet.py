"""``longarm study fleet``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from studies.commands import shape


@shape.study(
    click.option(
        *("--arms", "counts"), type=click.IntRange(min=1), multiple=True, default=(20, 200),
        show_default=True, help="Simulated arms; a larger number goes on after the smaller.",
    ),
    options.output(
        "build/fleet",
        "Folder for arms and diagnoses; existing results are continued.",
        outputs.left_to_the_command,
    ),
    shape.number("--jobs", 1, "Processes."),
    options.dask,
    options.seed,
)  # fmt: skip
def command(
    counts: tuple[int, ...], output: Path, jobs: int, dask: str | None, seed: int, show: shape.Show
) -> shape.Figures:
    """Simulated arms of one kind diagnosed by `longarm fleet`; its time and peaks of memory.

    \b
    Example:
      longarm study fleet --arms 20 --arms 200
      longarm study fleet --arms 8 --arms 16 --dask local --jobs 2
    """
    from studies.fleet import study

    rows = list(study(output, counts, seed, show, jobs, dask))
    return shape.Figures(
        {"seed": seed, "fleets": rows}, {"Fleets of simulated arms of one kind": rows}
    )
