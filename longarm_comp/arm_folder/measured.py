"""Reads and writes the record of measurements in an arm's folder, and the cameras' files.

The record, `measured.yaml`, says what was measured, when, by which command.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from longarm_comp.arm_folder.parameter_file import edit_text, parameters_of, parse_parameters
from longarm_comp.arm_folder.servos import KEYS, SERVOS
from longarm_comp.core.arm import quaternion
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_bytes, write_text, write_texts
from longarm_comp.core.strict_yaml import read_text, read_yaml

if TYPE_CHECKING:
    from longarm_comp.devices.stereo.calibrate import BoardCalibration

CAMERAS = "cameras"
SIDES = ("left", "right")
BRIDGE, SIMULATED = "stereo_bridge.yaml", "simulated_arm.yaml"
_NAMES = ("hand_eye.xyz", "hand_eye.quaternion")
FILE = "measured.yaml"
_HEAD = "# What was measured, when, by which command, and how well. `longarm check` lists it.\n"


@dataclass(frozen=True)
class Measured:
    """An entry of the record.

    Attributes:
        at: time of the measurement, ISO 8601, UTC.
        by: command that measured.
        facts: results, and how good they are.
        of: hash of the values that were measured (`_hash_values`); empty if it was not recorded.
    """

    at: str
    by: str
    facts: dict[str, Any]
    of: str = ""


def read_measured(folder: Path) -> dict[str, Measured]:
    """Return the record of a folder by file, {} without one. Raises InputError if it is damaged."""
    path = folder / FILE
    if not path.is_file():
        return {}
    data = read_yaml(path)
    try:
        return {
            str(file): Measured(
                str(entry["at"]), str(entry["by"]), dict(entry["facts"]), str(entry.get("of", ""))
            )
            for file, entry in data.items()
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        allowed = "FILE: {at, by, facts}, as the commands write it"
        raise InputError(path, "entry", repr(error), allowed) from error


def note_measured(folder: Path, file: str, by: str, facts: Mapping[str, Any]) -> None:
    """Add a measurement to the record; it replaces an earlier one of the same file."""
    write_text(folder / FILE, _with_entry(folder, file, by, facts))


def is_changed(folder: Path, file: str, entry: Measured) -> bool:
    """Tell whether the values of an entry of the record are others than those measured."""
    try:
        return bool(entry.of) and _hash_values(folder, file, {}) != entry.of
    except InputError:  # the file cannot be read
        return True


def _hash_values(folder: Path, file: str, written: Mapping[Path, str]) -> str:
    """Return a hash of the values in a folder that a measurement of a file finds or depends on.

    The place of the stereo head is that of a rectified camera, so it depends on the cameras.
    `written` are texts by their files, for those that are not written yet.
    """

    def text_of(path: Path) -> str:
        return written[path] if path in written else read_text(path) if path.is_file() else ""

    values: list[Any] = []
    if file in (CAMERAS, BRIDGE):
        values += [text_of(camera_path(folder, side)) for side in SIDES]
    if file in (SERVOS, BRIDGE):
        given = parse_parameters(text_of(folder / file), file)
        own = r"hand_eye\." if file == BRIDGE else rf"joints\..+\.({'|'.join(KEYS)})\b"
        values += sorted((name, value) for name, value in given.items() if re.match(own, name))
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


def _with_entry(
    folder: Path,
    file: str,
    by: str,
    facts: Mapping[str, Any],
    written: Mapping[Path, str] = MappingProxyType({}),
) -> str:
    """Return the text of the record with a measurement added; `written` as in `_hash_values`."""
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    made = Measured(now, by, dict(facts), _hash_values(folder, file, written))
    known = {**read_measured(folder), file: made}
    entries = {name: vars(entry) for name, entry in known.items()}
    text = yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=100)
    return _HEAD + text


def camera_path(folder: Path, side: str) -> Path:
    return folder / CAMERAS / f"{side}.yaml"


def write_cameras(folder: Path, found: BoardCalibration) -> list[Path]:
    """Write the files of both cameras and the entry in the record; return the files' paths.

    All are replaced, or none. The files of before are kept as ``left.previous.yaml`` and
    ``right.previous.yaml``.
    """
    from longarm_comp.devices.stereo.camera_file import calibration_of, camera_text

    cameras = dict(zip(SIDES, calibration_of(found.fit.rig), strict=True))
    head = (
        f"Calibrated from {len(found.fit.used)} views, {found.fit.rms_px:.3f} px rms; boards that "
        f"were left out:\n{found.held_out_mm:.3f} mm rms at {found.distances_m[0]:.2f} to "
        f"{found.distances_m[1]:.2f} m. Both files belong together."
    )
    facts = {
        "views": len(found.fit.used),
        "rms_px": round(found.fit.rms_px, 4),
        "held_out_mm": round(found.held_out_mm, 4),
    }
    files = {camera_path(folder, side): side for side in SIDES}
    # The record first: `write_texts` replaces its first file last
    texts = {file: camera_text(side, cameras[side], head) for file, side in files.items()}
    made = {folder / FILE: _with_entry(folder, CAMERAS, "stereo calibrate", facts, texts), **texts}
    for file, side in files.items():
        if file.is_file():
            write_bytes(camera_path(folder, f"{side}.previous"), file.read_bytes())
    write_texts(made)
    return list(files)


def head_at(folder: Path, session: str) -> np.ndarray:
    """Return the pose (4, 4) of the left optical frame in the base frame, as a session assumed it.

    It is the present one of stereo_bridge.yaml. If that was computed from this very session, it is
    the earlier one in the record.

    Args:
        session: hash of the session.
    """
    entry = read_measured(folder).get(BRIDGE)
    if entry is None or entry.facts.get("session") != session:
        file = folder / BRIDGE
        given = parameters_of("stereo_bridge", file)
        return _check_pose(file, "hand_eye", [given[name] for name in _NAMES])
    before = entry.facts.get("before")
    pair = (before.get("xyz"), before.get("quaternion")) if isinstance(before, dict) else ()
    return _check_pose(folder / FILE, f"{BRIDGE}: facts.before", pair)


def write_head(
    folder: Path, pose: np.ndarray, before: np.ndarray, session: str, facts: Mapping[str, Any]
) -> list[str]:
    """Write the pose of the left camera to the parameter files and the record.

    The simulated cameras, if there are any, get the same place and viewing direction; they stay
    level.

    Args:
        pose: (4, 4) left optical frame in the base frame.
        before: the same as assumed when the session was measured.
        session: hash of the session.
        facts: how good the pose is, for the record.

    Returns:
        Names of the parameter files that were written.
    """
    xyz, turn = _round_pose(pose)
    values = dict(zip(_NAMES, (xyz, turn), strict=True))
    old = dict(zip(("xyz", "quaternion"), _round_pose(before), strict=True))
    entry = {**facts, "session": session, "before": old}
    # `write_texts` replaces its first file, the record, last. Until then the same session may be
    # given again
    bridge = {folder / BRIDGE: _edit_values(folder / BRIDGE, values)}
    made = {folder / FILE: _with_entry(folder, BRIDGE, "stereo hand-eye", entry, bridge), **bridge}
    if (folder / SIMULATED).is_file():
        axis = [round(float(v), 9) for v in pose[:3, 2]]
        camera = {"camera.position": xyz, "camera.axis": axis}
        made[folder / SIMULATED] = _edit_values(folder / SIMULATED, camera)
    write_texts(made)
    return [path.name for path in made if path.name != FILE]


def _check_pose(file: Path, field: str, given: Sequence[Any]) -> np.ndarray:
    try:
        xyz, turn = (np.array(value, dtype=float) for value in given)
        good = xyz.shape == (3,) and turn.shape == (4,) and quaternion.is_unit(turn)
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(file, field, list(given), "xyz and a unit quaternion")
    return quaternion.compute_pose(xyz, turn)


def _round_pose(pose: np.ndarray) -> tuple[list[float], list[float]]:
    turn = quaternion.from_rotation(pose[:3, :3])
    return [round(float(v), 7) for v in pose[:3, 3]], [round(float(v), 12) for v in turn]


def _edit_values(file: Path, values: Mapping[str, Sequence[float]]) -> str:
    """Return the text of a parameter file with other values."""
    parameters = {tuple(k.split(".")): v for k, v in values.items()}
    return edit_text(read_text(file), parameters, file)
