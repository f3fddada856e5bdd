"""``longarm check``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, say
from longarm_comp.core.errors import JobError


@click.command()
@options.folder
@options.as_json
def command(folder: Path) -> None:
    """List what an arm's folder lacks (missing, implausible, unmeasured) and what was measured.

    Reads arm.yaml and the servo, camera and marker files beside it, compares them with each
    other, and computes at how many poses the cameras see the marker. Lists the declared beams and
    prints the sag of the arm held out; compare both with the real arm. The exit code is 3 if
    something is missing or implausible, and 0 if values are only unmeasured. Values that `servo
    setup`, `stereo calibrate` and `stereo hand-eye` wrote count as measured until they are changed.

    \b
    Example:
      longarm check my_arm
    """
    from longarm_comp.arm_folder.check import check_folder

    found = check_folder(folder)
    print_json([vars(finding) for finding in found])
    for finding in found:
        say(f"{finding.level:12}{finding.where}: {finding.text}")
    if all(finding.level in ("measured", "declared") for finding in found):
        note("nothing is missing, implausible or unmeasured")
    blocking = sum(finding.blocks for finding in found)
    if blocking:
        raise JobError(f"{folder} cannot be used yet", to_put_right=blocking)
