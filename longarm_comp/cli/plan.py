"""``longarm plan``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json


@click.command()
@options.arm
@click.option(
    "--kind",
    type=click.Choice(["grid", "sobol", "next"]),
    required=True,
    help="grid: the paper's levels; sobol: fills the joint box; next: from a diagnosis.",
)
@click.option("-n", "count", type=int, required=True, help="How many poses.")
@options.path_option("--report", "Folder of a diagnosis (for --kind next).")
@options.output("poses.csv", "Plan to write.")
@options.seed
@options.as_json
def command(
    arm: Path,
    kind: Literal["grid", "sobol", "next"],
    count: int,
    report: Path | None,
    output: Path,
    seed: int,
    as_json: bool,
) -> None:
    """Write N poses to measure ARM at, each with the side that every joint arrives from.

    \b
    Examples:
      longarm plan arm.yaml --kind grid -n 300 -o poses.csv
      longarm plan arm.yaml --kind next -n 20 --report diagnosis -o poses.csv
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.errors import InputError
    from longarm_comp.sessions.poses import write_poses
    from longarm_comp.workflows.plan import plan

    declared = Arm.load(arm)
    if (kind == "next") != (report is not None):
        raise InputError("plan", "--report", report, "a diagnosis folder with --kind next, only")
    if kind == "next":
        poses = plan(declared, count, report=report)
    else:
        poses = plan(declared, count, kind=kind, seed=seed)
    write_poses(poses, output)
    if as_json:
        print_json({"output": str(output), "poses": poses.q, "approach": poses.approach})
    else:
        note(f"{len(poses)} poses in {output}")
