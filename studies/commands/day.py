"""``longarm study day``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=12, show_default=True,
    help="Simulated arms, with other hidden effects each.",
)  # fmt: skip
@click.option(
    "--hours", type=click.IntRange(min=1), default=8, show_default=True, help="Hours of work."
)
@click.option(
    "--moves", type=click.IntRange(min=1), default=12, show_default=True, help="Targets an hour."
)
@click.option("--quiet", is_flag=True, help="No play grows.")
@click.option("--fast", is_flag=True, help="Without the ways that diagnose during the day.")
@options.seed
@options.as_json
@options.written(
    "-o/--output",
    "Folder for day.json, day.png and a file an arm, from which a broken study goes on.",
    outputs.folder("day.json", "day.png", told_by="day.json"),
)
def command(
    arm: Path | None,
    count: int,
    hours: int,
    moves: int,
    quiet: bool,
    fast: bool,
    seed: int,
    as_json: bool,
    output: Path | None,
) -> None:
    """Command a simulated arm for a day while it wears, warms up and carries other loads.

    Compares no compensation, one calibration, a calibration that is told the circumstances, one
    that is diagnosed again when the drift monitor asks, and one that learns at work. Errors are of
    the true tip, at the targets that were served. Each arm takes some minutes.

    \b
    Example:
      longarm study day --arms 12 -o build/day
    """
    import json
    from typing import Any

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.files import write_text
    from longarm_comp.share import folder
    from studies import day, day_file

    setting = day.DaySetting(
        Arm.load(arm or folder("config") / "arm_demo.yaml"), hours=hours, moves=moves
    )
    if quiet:
        setting = day.replace(setting, growth_rad=0.0)
    ways = [way for way in day.WAYS if not (fast and way.watched)]
    found: list[day.DayOutcome] = []
    with progress("study day") as show:
        for number in range(seed, seed + count):
            found.append(day_file.kept(output, setting, number, ways))
            show(f"{len(found)} of {count} days", len(found) / count)
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
    facts: dict[str, Any] = {
        "arms": count, "seed": seed, "hours": hours, "moves": moves, "rows": rows,
        "stops": stops, "changes": changes,
    }  # fmt: skip
    if output is not None:
        from studies.day_figure import day_figure

        output.mkdir(parents=True, exist_ok=True)
        write_text(output / "day.json", json.dumps(facts, indent=2))
        day_figure(found, output / "day.png")
    if as_json:
        print_json(facts)
        return
    print_rows(f"A day of {hours} h: {count} arms, {moves} targets an hour", rows)
    print_rows("What the monitor asked for", stops)
    print_rows("What was learned at work", changes)
