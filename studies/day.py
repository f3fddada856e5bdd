"""Days of work: the table, the files and the figure of many (`studies/day_work.py` is one day)."""

import dataclasses
import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.files import write_text
from studies.commands import Figures, Show, arm_option, arms_option, study_command, whole_number
from studies.day_work import ROW_H, WAYS, DayOutcome, DaySetting, Stop, one_day

ARRAYS = ("t_h", "temperature_c", "payload_kg", "play_rad", "error")
"""Fields of `DayOutcome` that are arrays."""


def table(found: Sequence[DayOutcome], hours: float, parts: int = 4) -> list[dict[str, object]]:
    """Return a row a way: poses, minutes and targets lost to standing still, and the errors, a day.

    3-D errors of the true tip in mm at the targets that were served: mean and p95, and the mean of
    each part of the day.
    """
    rows: list[dict[str, object]] = []
    edges = np.linspace(0.0, hours, parts + 1)
    t = np.concatenate([day.t_h for day in found])
    for name in found[0].ways:
        errors = 1e3 * np.concatenate([day.of(name) for day in found])
        poses = sum(stop.poses for day in found for stop in day.stops_of(name)) / len(found)
        row: dict[str, object] = {
            "commanded": name,
            "poses": poses,
            "minutes": 60.0 * ROW_H * poses,
            "not_served": float(np.isnan(errors).sum()) / len(found),
            "mean_mm": float(np.nanmean(errors)),
            "p95_mm": float(np.nanpercentile(errors, 95)),
        }
        for low, high in itertools.pairwise(edges):
            chosen = errors[(t >= low) & (t < high)]
            served = chosen[np.isfinite(chosen)]
            row[f"{low:g}-{high:g} h, mm"] = float(served.mean()) if len(served) else None
        rows.append(row)
    return rows


def read_or_make_day(folder: Path | None, setting: DaySetting, seed: int) -> DayOutcome:
    """Read a day from its folder if it is of the same setting; else make it and write it there."""
    if folder is None:
        return one_day(setting, seed)
    path = folder / f"day_{seed}.json"
    asked = f"{setting!r} {WAYS!r}"
    if path.is_file():
        held = json.loads(path.read_text())
        if held.pop("asked") == asked:
            held |= {name: np.array(held[name], dtype=float) for name in ARRAYS}
            held["stops"] = tuple(Stop(**stop) for stop in held["stops"])
            held["changes"] = tuple((hour, said) for hour, said in held["changes"])
            return DayOutcome(**held | {"ways": tuple(held["ways"])})
    made = one_day(setting, seed)
    folder.mkdir(parents=True, exist_ok=True)
    facts = dataclasses.asdict(made) | {name: getattr(made, name).tolist() for name in ARRAYS}
    write_text(path, json.dumps(facts | {"asked": asked}))
    return made


@study_command(
    arm_option,
    arms_option(12, "Simulated arms, with other hidden effects each."),
    whole_number("--hours", 8, "Hours of work."),
    whole_number("--moves", 12, "Targets an hour."),
    click.option("--quiet", is_flag=True, help="No play grows."),
    options.seed,
    options.written_option(
        "-o/--output",
        "Folder for day.json, day.png and a file an arm, from which a stopped study continues.",
        outputs.folder("day.json", "day.png", told_by="day.json"),
    ),
)
def command(
    arm: Arm, arms: int, hours: int, moves: int, quiet: bool, seed: int,
    output: Path | None, show: Show,
) -> Figures:  # fmt: skip
    """Command a simulated arm for a day while it wears, warms up and carries other loads.

    Compares no compensation, one calibration, a calibration that knows the circumstances, and one
    that learns at work. Errors are of the true tip, at the targets that were served. Each arm takes
    some minutes.

    \b
    Example:
      longarm study day --arms 12 -o build/day
    """
    setting = DaySetting(arm, hours=hours, moves=moves)
    if quiet:
        setting = replace(setting, growth_rad=0.0)
    found: list[DayOutcome] = []
    for number in range(seed, seed + arms):
        found.append(read_or_make_day(output, setting, number))
        show(f"{len(found)} of {arms} days", len(found) / arms)
    rows = table(found, hours)
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
        from studies.day_figure import draw_days

        write_text(output / "day.json", json.dumps(facts, indent=2))
        draw_days(found, output / "day.png")
    return Figures(
        facts,
        {
            f"A day of {hours} h: {arms} arms, {moves} targets an hour": rows,
            "What was measured for its own sake": stops,
            "What was learned at work": changes,
        },
    )
