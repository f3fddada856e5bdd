"""``longarm study real``."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, progress

_STEPS = 24  # fits in all, roughly: for the bar only


@click.command()
@options.path_option("--data", "Folder with dlr_justin and wam_ur5.", required=True)
@options.as_json
def command(data: Path, as_json: bool) -> None:
    """Held-out errors on real arms: DLR Agile Justin, Barrett WAM, UR5.

    "best" holds the effects that are selected on the training rows. "frames_only" fits only the
    placement of base and tool, which is often a large part of a published "before".

    \b
    Example:
      longarm study real --data shared/data/real --json
    """
    from studies.real import study

    with progress("study real") as show:
        steps = iter(range(_STEPS))
        robots = study(data, lambda text: show(text, min(next(steps, _STEPS), _STEPS) / _STEPS))
    rows = {
        robot: [
            {
                "model": line.model,
                "mean_mm": 1e3 * line.errors.mean,
                "ci95_mm": [1e3 * end for end in line.ci95],
                "rms_mm": 1e3 * line.errors.rms,
                "max_mm": 1e3 * line.errors.max,
                "n": line.errors.n,
                "effects": list(line.effects),
            }
            for line in lines
        ]
        for robot, lines in robots.items()
    }
    if as_json:
        print_json(rows)
        return
    for robot, lines in rows.items():
        shown = [
            {k: v for k, v in line.items() if k not in ("effects", "ci95_mm")} for line in lines
        ]
        print_rows(f"{robot}: errors on the test rows", shown)
        low, high = cast("tuple[float, float]", lines[-1]["ci95_mm"])
        note(f"{robot}: 95 % of the best mean {low:.3f} to {high:.3f} mm")
        best = lines[-1]["effects"]
        note(f"{robot}: best holds {', '.join(best) if best else 'nothing beyond geometry'}")  # type: ignore[arg-type]
