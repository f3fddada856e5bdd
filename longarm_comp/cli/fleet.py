"""``longarm fleet``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_table, progress
from longarm_comp.core.errors import JobError

if TYPE_CHECKING:
    from longarm_comp.workflows.fleet import Diagnosed


@click.command()
@options.folder
@options.output(
    "fleet",
    "Folder to write: one diagnosis for each arm, fleet.json, fleet.html.",
    outputs.folder("fleet.json", told_by="fleet.json", schema="longarm/fleet/1"),
)
@click.option("--jobs", type=click.IntRange(min=1), default=1, help="Processes.")
@click.option("--dask", metavar="ADDRESS", help="Dask scheduler whose workers see the same files.")
@options.without("network", "Train no network on the remaining error.")
@options.seed
@options.as_json
def command(folder: Path, output: Path, **how: Any) -> None:
    """Diagnose every arm in DIR and compare them: which arm drifts, which effects all arms have.

    DIR has one folder for each arm, with arm.yaml, sessions (the newest is used) and, if there is
    one, the model.yaml in use. Or DIR has one arm.yaml and one session for each arm. Called again,
    the command continues, and diagnoses again what changed.

    \b
    Examples:
      longarm fleet examples/panda_touch -o fleet --jobs 2
      longarm fleet arms -o fleet
    """
    from longarm_comp.core.files import write_text
    from longarm_comp.report.pages import fleet_page
    from longarm_comp.workflows.fleet import fleet

    with progress("fleet") as show:
        arms = fleet(folder, output, progress=show, **how)
    write_text(output / "fleet.html", fleet_page(folder.resolve().name, [a.row for a in arms]))
    if all(arm.verdict == "failed" for arm in arms):
        raise JobError(f"no arm of {folder} could be diagnosed: {arms[0].summary}")
    print_json({"output": output, "arms": [arm.row for arm in arms]})
    header = ("arm", "rows", "verdict", "in use, mm", "calibrated, mm", "diagnosed, mm", "found")
    print_table(f"{len(arms)} arms", header, [_cells(arm) for arm in arms])
    for arm in arms:
        if arm.verdict == "failed":
            note(f"{arm.name}: {arm.summary}")
        if arm.drifted:
            note(f"{arm.name} drifted: its model errs by {arm.in_use_mm:.2f} mm, a calibration of "
                 f"today by {arm.calibrated_mm:.2f} mm")  # fmt: skip
    note(f"page in {output / 'fleet.html'}; a diagnosis an arm and fleet.json beside it")


def _cells(arm: Diagnosed) -> tuple[str, ...]:
    found: dict[str, list[str]] = {}
    for f in arm.findings:
        found.setdefault(f.effect, []).append(f.where + " (of the kind)" * f.of_kind)
    effects = "; ".join(f"{effect} at {', '.join(where)}" for effect, where in found.items())
    mm = (arm.in_use_mm, arm.calibrated_mm, arm.diagnosed_mm)
    said = ("" if value is None else f"{value:.2f}" for value in mm)
    return (arm.name, str(arm.rows), arm.verdict, *said, effects)
