"""``longarm check``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json
from longarm_comp.core.errors import JobError


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@options.as_json
def command(folder: Path, as_json: bool) -> None:
    """Say what an arm's folder lacks: missing, implausible, unmeasured; and what was measured.

    Reads arm.yaml and the servo, camera and marker files beside it, compares them with each
    other, and computes at how many poses the cameras see the marker. Lists the declared
    beams as they stand and prints the sag of the arm held out: compare both with the arm. Exit
    code 3 where something is missing or implausible; what is only unmeasured leaves 0. What
    `servo setup`, `stereo calibrate` and `stereo hand-eye` wrote counts as measured.

    \b
    Example:
      longarm check my_arm
    """
    from longarm_comp.arm_folder.check import check_folder

    found = check_folder(folder)
    if as_json:
        print_json([{"level": f.level, "where": f.where, "text": f.text} for f in found])
    else:
        for finding in found:
            click.echo(f"{finding.level:12}{finding.where}: {finding.text}")
        if all(finding.level in ("measured", "declared") for finding in found):
            note("nothing is missing, implausible or unmeasured")
    blocking = sum(finding.blocks for finding in found)
    if blocking:
        raise JobError(f"{folder} cannot be used yet", to_put_right=blocking)
