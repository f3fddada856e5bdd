"""Where the cameras stand, written into an arm's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.arm_folder.measured import FILE, note_measured, read_measured
from longarm_comp.arm_folder.parameter_file import parameters_of
from longarm_comp.arm_folder.yaml_edit import edited, ros_path
from longarm_comp.core.arm import quaternion
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text

BRIDGE, SIMULATED = "stereo_bridge.yaml", "simulated_arm.yaml"
_NAMES = ("hand_eye.xyz", "hand_eye.quaternion")


def head_pose(folder: Path) -> np.ndarray:
    """Left optical frame in the base frame (4, 4), as the folder's stereo_bridge.yaml has it."""
    file = folder / BRIDGE
    given = parameters_of("stereo_bridge", file)
    return _pose(file, "hand_eye", [given[name] for name in _NAMES])


def head_at(folder: Path, session: str) -> np.ndarray:
    """Where the head was taken to stand when a session was measured (4, 4).

    That is what the file has now, unless it was written from this very session.
    """
    entry = read_measured(folder).get(BRIDGE)
    if entry is None or entry.facts.get("session") != session:
        return head_pose(folder)
    before = entry.facts.get("before")
    pair = (before.get("xyz"), before.get("quaternion")) if isinstance(before, dict) else ()
    return _pose(folder / FILE, f"{BRIDGE}: facts.before", pair)


def write_head(
    folder: Path, pose: np.ndarray, before: np.ndarray, session: str, facts: Mapping[str, Any]
) -> list[str]:
    """Write where the left camera stands; the simulated cameras move there too, level.

    Args:
        pose: (4, 4) left optical frame in the base frame.
        before: (4, 4) where it was taken to stand when the session was measured.
        session: its hash.
        facts: how good it is, for the record.

    Returns:
        Names of the files that were written.
    """
    xyz, turn = _numbers(pose)
    values = dict(zip(_NAMES, (xyz, turn), strict=True))
    told = {
        **facts,
        "session": session,
        "before": dict(zip(("xyz", "quaternion"), _numbers(before), strict=True)),
    }
    # The record first: it says where the head was, if the rest is broken off and done again.
    note_measured(folder, BRIDGE, "stereo hand-eye", told)
    _edit(folder / BRIDGE, values)
    written = [BRIDGE]
    if (folder / SIMULATED).is_file():
        axis = [round(float(v), 9) for v in pose[:3, 2]]
        _edit(folder / SIMULATED, {"camera.position": xyz, "camera.axis": axis})
        written.append(SIMULATED)
    return written


def _pose(file: Path, field: str, given: Sequence[Any]) -> np.ndarray:
    """(4, 4) of a position and a quaternion."""
    try:
        xyz, turn = (np.array(value, dtype=float) for value in given)
        good = xyz.shape == (3,) and turn.shape == (4,) and quaternion.is_unit(turn)
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(file, field, list(given), "xyz and a unit quaternion")
    return quaternion.pose(xyz, turn)


def _numbers(pose: np.ndarray) -> tuple[list[float], list[float]]:
    turn = quaternion.from_rotation(pose[:3, :3])
    return [round(float(v), 7) for v in pose[:3, 3]], [round(float(v), 12) for v in turn]


def _edit(file: Path, values: Mapping[str, Sequence[float]]) -> None:
    text = file.read_text("utf-8")
    root = ros_path(text)
    write_text(file, edited(text, {(*root, *k.split(".")): v for k, v in values.items()}, file))
