"""What of a folder was measured: the record against the files as they are now."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from longarm_comp.arm_folder.camera_files import CAMERAS, SIDES, camera_path, camera_values
from longarm_comp.arm_folder.findings import FolderFinding, implausible, measured, unmeasured
from longarm_comp.arm_folder.measured import FILE, Measured, read_measured
from longarm_comp.arm_folder.parameter_file import read_parameters
from longarm_comp.arm_folder.servo_file import SERVOS, servo_values
from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_config import ServoConfig


def recorded(folder: Path, file: str) -> bool:
    """Whether a file holds what was measured last."""
    try:
        entry = read_measured(folder).get(file)
        return entry is not None and not entry.changed(_now(folder, file))
    except InputError:
        return False


def of_record(folder: Path) -> Iterator[FolderFinding]:
    """Findings on every measurement, and on cameras without a calibration."""
    try:
        entries = read_measured(folder)
    except InputError as error:
        yield implausible(f"{FILE}: {error.field}", f"{error.value}; allowed: {error.allowed}")
        return
    for file, entry in entries.items():
        yield from _of_entry(folder, file, entry)
    if CAMERAS not in entries:
        files = [camera_path(folder, side).is_file() for side in SIDES]
        if not all(files):
            said = "no calibration (longarm stereo calibrate), unless the camera driver has one"
            yield unmeasured(CAMERAS, said)


def _of_entry(folder: Path, file: str, entry: Measured) -> Iterator[FolderFinding]:
    try:
        changed = entry.changed(_now(folder, file))
    except InputError as error:
        if file == CAMERAS:  # the other files are checked for themselves
            text = f"{error.value}; allowed: {error.allowed}"
            yield implausible(f"{CAMERAS}: {error.field}", text)
        return
    if changed:
        names = ", ".join(changed[:3]) + (" and others" if len(changed) > 3 else "")
        said = f"{names} changed by hand since {entry.at} ({entry.by}): measure again"
        yield unmeasured(f"{file}: changed", said)
    else:
        told = {k: v for k, v in entry.facts.items() if k not in ("session", "before")}
        facts = ", ".join(f"{name} {value}" for name, value in told.items())
        yield measured(file, f"{entry.at}, longarm {entry.by}: {facts}")


def _now(folder: Path, file: str) -> dict[str, Any]:
    """Values of a file as the record names them. Raises InputError."""
    if file == CAMERAS:
        return camera_values(folder)
    if file == SERVOS:
        return servo_values(ServoConfig.load(folder / file).joints)
    return read_parameters(folder / file)
