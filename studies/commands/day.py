"""``longarm study day``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=3, show_default=True,
    help="Simulated arms, with other hidden effects each.",
)  # fmt: skip
@click.option(
    "--hours", type=click.IntRange(min=1), default=8, show_default=True, help="Hours of work."
)
@click.option(
    "--moves", type=click.IntRange(min=1), default=12, show_default=True, help="Targets an hour."
)
@options.seed
@options.as_json
@options.written(
    "-o/--output",
    "Folder for day.json and day.png.",
    outputs.folder("day.json", "day.png", told_by="day.json"),
)
def command(
    arm: Path | None,
    count: int,
    hours: int,
    moves: int,
    seed: int,
    as_json: bool,
    output: Path | None,
) -> None:
    """Command a simulated arm for a day while it wears, warms up and carries other loads.

    Compares no compensation, one calibration, a calibration that is told the circumstances, and
    one that is diagnosed again when the drift monitor asks. Errors are of the true tip. Each arm
    takes about a minute.

    \b
    Example:
      longarm study day --arms 3 -o build/day
    """
    import json
    from typing import Any

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.files import write_text
    from longarm_comp.share import folder
    from studies import day

    setting = day.DaySetting(
        Arm.load(arm or folder("config") / "arm_demo.yaml"), hours=hours, moves=moves
    )
    found: list[day.DayOutcome] = []
    with progress("study day") as show:
        for outcome in day.days(setting, range(seed, seed + count)):
            found.append(outcome)
            show(f"{len(found)} of {count} days", len(found) / count)
    rows = day.table(found)
    asked = [
        {"arm": k, "hour": hour, "said": said}
        for k, outcome in enumerate(found)
        for hour, said in zip(outcome.asked_h, outcome.said, strict=True)
    ]
    facts: dict[str, Any] = {
        "arms": count, "seed": seed, "hours": hours, "moves": moves, "rows": rows, "asked": asked,
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
    print_rows("What the monitor asked for", asked)
