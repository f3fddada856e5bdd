"""Writes an arm's folder, whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from longarm_comp.arm_folder.arm_text import arm_text
from longarm_comp.arm_folder.head import head_for
from longarm_comp.arm_folder.parameter_file import own_text, ros_parameters, with_values
from longarm_comp.arm_folder.servos import DEFAULT_MODEL, servo_section
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml
from longarm_comp.devices.servo_bus import models
from longarm_comp.share import folder

ARM = "arm.yaml"
NODES = ("servo_driver", "stereo_bridge", "simulated_arm")
"""Nodes whose parameter files depend on the arm; the package's own serve for the others."""

_SERVOS = """The servos of {name}, one a joint. ASSUMED, so set all of it: servo_id, model,
gear_ratio or pinion_radius_m, direction, zero_ticks (reading at joint value 0), max_velocity.
Every key: docs/ros.md and devices/servo_config.py."""
_BRIDGE = """The stereo head beside {name}, and the marker on its tip. ASSUMED: hand_eye (where
the left camera stands), tag_m, gap_m (measure the print), tip_in_marker (0: its middle)."""
_SIMULATED = (
    """The simulated {name}. Cameras and marker stand where stereo_bridge.yaml says they do."""
)


@dataclass(frozen=True)
class Source:
    """What an arm's folder is made from."""

    text: str
    arm: Arm

    @classmethod
    def of_data(cls, data: Mapping[str, Any], head: str, of_rows: Mapping[int, str]) -> Source:
        """From what arm.yaml shall hold; the camera is added."""
        arm = Arm.parse(dict(data), ARM)
        seen = head_for(arm)
        camera = {"position_m": list(seen.position_m), "optical_axis": list(seen.axis)}
        whole = {**data, "camera": camera}
        return cls(arm_text(whole, head, of_rows), Arm.parse(whole, ARM))

    @classmethod
    def of_file(cls, path: Path) -> Source:
        """An arm.yaml that is there already."""
        arm = Arm.load(path)
        return cls(path.read_text("utf-8"), arm)


def parameter_files(arm: Arm, servos: str = DEFAULT_MODEL, direct: bool = False) -> dict[str, str]:
    """Texts of the parameter files that fit an arm, by node."""
    head = head_for(arm)
    carried = arm.payload.mass_kg if arm.payload else 0.0
    bus = ros_parameters(parse_yaml(own_text("servo_driver"), "servo_driver"), "servo_driver")[
        "bus"
    ]
    values: dict[str, dict[str, Any]] = {
        "servo_driver": {
            "joints": servo_section(arm, servos, direct),
            "bus": bus | {"protocol": models()[servos].protocol},
        },
        "stereo_bridge": head.bridge(),
        "simulated_arm": head.simulated()
        | {"payload_kg": carried, "temperature_c": arm.reference_temperature_c},
    }
    heads = dict(zip(NODES, (_SERVOS, _BRIDGE, _SIMULATED), strict=True))
    return {
        node: with_values(node, values[node], heads[node].format(name=arm.name)) for node in NODES
    }


def demonstration() -> dict[str, str]:
    """Texts of the demonstration's files by name."""
    files = {f"{node}.yaml": own_text(node) for node in NODES}
    return {ARM: (folder("config") / "arm_demo.yaml").read_text("utf-8"), **files}


def files_of(source: Source, servos: str = DEFAULT_MODEL, direct: bool = False) -> dict[str, str]:
    """Texts of all files of an arm's folder by name; ``direct``: as in `servo_section`."""
    made = parameter_files(source.arm, servos, direct)
    return {ARM: source.text, **{f"{node}.yaml": text for node, text in made.items()}}


def check_free(out: Path) -> None:
    """Raise InputError where a folder cannot be made because something is there."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("init", "DIR", out, "a new or empty folder")


def write_folder(out: Path, files: Mapping[str, str]) -> None:
    """Write a new folder of files in one step."""
    check_free(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
        try:
            for name, text in files.items():
                (made / name).write_text(text, encoding="utf-8", newline="\n")
            made.chmod(0o755)
            os.replace(made, out)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    except OSError as error:
        raise InputError(out, "DIR", error.strerror or str(error), "a folder to write") from error
