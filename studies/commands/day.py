"""``longarm study day``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options, outputs
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    shape.arm,
    shape.arms(12, "Simulated arms, with other hidden effects each."),
    shape.number("--hours", 8, "Hours of work."),
    shape.number("--moves", 12, "Targets an hour."),
    click.option("--quiet", is_flag=True, help="No play grows."),
    click.option("--fast", is_flag=True, help="Without the ways that diagnose during the day."),
    options.seed,
    options.written_option(
        "-o/--output",
        "Folder for day.json, day.png and a file an arm, from which a stopped study continues.",
        outputs.folder("day.json", "day.png", told_by="day.json"),
    ),
)
def command(
    arm: Arm, arms: int, hours: int, moves: int, quiet: bool, fast: bool, seed: int,
    output: Path | None, show: shape.Show,
) -> shape.Figures:  # fmt: skip
    """Command a simulated arm for a day while it wears, warms up and carries other loads.

    Compares no compensation, one calibration, a calibration that knows the circumstances, one that
    is diagnosed again when the drift monitor asks, and one that learns at work. Errors are of
    the true tip, at the targets that were served. Each arm takes some minutes.

    \b
    Example:
      longarm study day --arms 12 -o build/day
    """
    from longarm_comp.core.files import write_text
    from studies import day, day_file

    setting = day.DaySetting(arm, hours=hours, moves=moves)
    if quiet:
        setting = day.replace(setting, growth_rad=0.0)
    ways = [way for way in day.WAYS if not (fast and way.watched)]
    found: list[day.DayOutcome] = []
    for number in range(seed, seed + arms):
        found.append(day_file.kept(output, setting, number, ways))
        show(f"{len(found)} of {arms} days", len(found) / arms)
    rows = day.table(found, hours)
    stops = [
        {"arm": k, "commanded": stop.way, "hour": stop.hour, "said": stop.said}
        for k, outcome in enumerate(found)
        for stop in outcome.stops
    ]
    changes = [
        {"arm": k, "hour": hour, "found": said}
        for k, outcome in enumerate(found)
        for hour, said in outcome.changes
    ]
    facts = {
        "arms": arms, "seed": seed, "hours": hours, "moves": moves, "rows": rows,
        "stops": stops, "changes": changes,
    }  # fmt: skip
    if output is not None:
        from studies.day_figure import day_figure

        output.mkdir(parents=True, exist_ok=True)
        write_text(output / "day.json", json.dumps(facts, indent=2))
        day_figure(found, output / "day.png")
    return shape.Figures(
        facts,
        {
            f"A day of {hours} h: {arms} arms, {moves} targets an hour": rows,
            "What the monitor asked for": stops,
            "What was learned at work": changes,
        },
    )
