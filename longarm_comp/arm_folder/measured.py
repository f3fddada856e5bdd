"""What was measured of an arm's folder: `measured.yaml`, written by the commands that measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import yaml

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.core.strict_yaml import read_yaml

FILE = "measured.yaml"
_HEAD = "# What was measured, when, by which command, and how well. `longarm check` lists it.\n"


@dataclass(frozen=True)
class Measured:
    """One measurement: when, by which command, and what was found of it."""

    at: str
    by: str
    facts: dict[str, Any]


def read_measured(folder: Path) -> dict[str, Measured]:
    """Measurements of a folder by file name."""
    path = folder / FILE
    if not path.is_file():
        return {}
    data = read_yaml(path)
    try:
        return {
            str(file): Measured(str(entry["at"]), str(entry["by"]), dict(entry["facts"]))
            for file, entry in data.items()
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        allowed = "FILE: {at, by, facts}, as the commands write it"
        raise InputError(path, "entry", repr(error), allowed) from error


def note_measured(folder: Path, file: str, by: str, facts: Mapping[str, Any]) -> None:
    """Add a measurement to the record, in place of an earlier one of the same file."""
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    known = {**read_measured(folder), file: Measured(now, by, dict(facts))}
    entries = {name: vars(entry) for name, entry in known.items()}
    text = yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=100)
    write_text(folder / FILE, _HEAD + text)
