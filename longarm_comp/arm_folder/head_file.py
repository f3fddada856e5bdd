"""Where the cameras stand, written into an arm's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.arm_folder.measured import note_measured
from longarm_comp.arm_folder.parameter_file import own_parameters, read_parameters
from longarm_comp.arm_folder.yaml_edit import edited, ros_path
from longarm_comp.core.arm import quaternion
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.core.strict_yaml import parse_yaml

BRIDGE, SIMULATED = "stereo_bridge.yaml", "simulated_arm.yaml"
_NAMES = ("hand_eye.xyz", "hand_eye.quaternion")


def head_pose(folder: Path) -> np.ndarray:
    """Left optical frame in the base frame (4, 4), as the folder's stereo_bridge.yaml has it.

    Raises:
        InputError: the file cannot be read, or holds no rigid motion.
    """
    file = folder / BRIDGE
    given = own_parameters("stereo_bridge") | read_parameters(file)
    try:
        xyz, turn = (np.array(given[name], dtype=float) for name in _NAMES)
        good = xyz.shape == (3,) and turn.shape == (4,) and quaternion.is_unit(turn)
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(file, "hand_eye", [given[n] for n in _NAMES], "xyz and a unit quaternion")
    return quaternion.pose(xyz, turn)


def write_head(folder: Path, pose: np.ndarray, facts: Mapping[str, Any]) -> list[str]:
    """Write where the left camera stands; the simulated cameras move there too, level.

    Args:
        pose: (4, 4) left optical frame in the base frame.
        facts: how good it is, for the record.

    Returns:
        Names of the files that were written.
    """
    xyz = [round(float(v), 7) for v in pose[:3, 3]]
    turn = [round(float(v), 12) for v in quaternion.from_rotation(pose[:3, :3])]
    values = dict(zip(_NAMES, (xyz, turn), strict=True))
    _edit(folder / BRIDGE, values)
    written = [BRIDGE]
    if (folder / SIMULATED).is_file():
        axis = [round(float(v), 9) for v in pose[:3, 2]]
        _edit(folder / SIMULATED, {"camera.position": xyz, "camera.axis": axis})
        written.append(SIMULATED)
    note_measured(folder, BRIDGE, "stereo hand-eye", values, facts)
    return written


def _edit(file: Path, values: Mapping[str, Sequence[float]]) -> None:
    text = file.read_text("utf-8")
    parse_yaml(text, str(file))
    root = ros_path(text)
    write_text(file, edited(text, {(*root, *k.split(".")): v for k, v in values.items()}, file))
