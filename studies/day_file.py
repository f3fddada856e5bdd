"""A day of the study on disk, so that a broken study goes on."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.files import write_text
from studies import day

_ARRAYS = ("t_h", "temperature_c", "payload_kg", "play_rad", "error")


def kept(
    folder: Path | None, setting: day.DaySetting, seed: int, ways: Sequence[day.Way]
) -> day.DayOutcome:
    """A day as a folder holds it, if it was of the same setting; else lived, and kept there."""
    if folder is None:
        return day.one_day(setting, seed, ways)
    path = folder / f"day_{seed}.json"
    asked = f"{setting!r} {tuple(ways)!r}"
    if path.is_file():
        held = json.loads(path.read_text())
        if held.pop("asked") == asked:
            return _read(held)
    made = day.one_day(setting, seed, ways)
    folder.mkdir(parents=True, exist_ok=True)
    facts = dataclasses.asdict(made) | {n: getattr(made, n).tolist() for n in _ARRAYS}
    write_text(path, json.dumps(facts | {"asked": asked}))
    return made


def _read(held: dict[str, Any]) -> day.DayOutcome:
    arrays = {name: np.array(held[name], dtype=float) for name in _ARRAYS}
    stops = tuple(day.Stop(**stop) for stop in held["stops"])
    changes = tuple((hour, said) for hour, said in held["changes"])
    return day.DayOutcome(ways=tuple(held["ways"]), stops=stops, changes=changes, **arrays)
