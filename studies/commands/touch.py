"""``longarm study touch``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, progress

_STEPS = 25  # places of the six arms: for the bar only


@click.command()
@options.path_option("--data", "Folder with a CSV an arm: location, socket, q1..q7.", required=True)
@options.as_json
def command(data: Path, as_json: bool) -> None:
    """What calibration and diagnosis leave at sockets held out in turn, on real arms.

    nominal: the data sheet, with the place of the ball; rigid: its geometry calibrated;
    diagnosed: with what a diagnosis of the same rows added.

    \b
    Example:
      longarm study touch --data shared/data/real/touch_pandas --json
    """
    from studies.touch import lines, study

    with progress("study touch") as show:
        steps = iter(range(_STEPS))
        found = lines(study(data, lambda text: show(text, next(steps, _STEPS) / _STEPS)))
    *arms, together = found
    if as_json:
        print_json({"arms": arms, "all": together})
        return
    shown = [{k: v for k, v in row.items() if k != "names" and "ci95" not in k} for row in found]
    print_rows("Mean distance from the touched point, each place held out in turn", shown)
    between = together["gain_ci95_mm"]
    note(f"diagnosed leaves less than rigid, over places: {together['gain_mm']} {between} mm")
    said = {k: together[f"{k}_ci95_mm"] for k in ("nominal", "rigid", "diagnosed")}
    note("95 % of the means, over places, mm: " + ", ".join(f"{k} {v}" for k, v in said.items()))
    for row in arms:
        note(f"{row['arm']}: {', '.join(row['names']) or 'nothing named'}")  # type: ignore[arg-type]
