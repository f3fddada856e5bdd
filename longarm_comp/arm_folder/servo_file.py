"""The servo file of an arm's folder, with values that were measured on the bus."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from longarm_comp.arm_folder.measured import note_measured
from longarm_comp.arm_folder.yaml_edit import edited, ros_path
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_text
from longarm_comp.core.strict_yaml import parse_yaml
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_joint import JointConfig

SERVOS = "servo_driver.yaml"
KEYS = ("servo_id", "model", "direction", "zero_ticks")
"""What a setup finds of each joint."""


def with_joints(
    text: str, bus: Mapping[str, Any], joints: Mapping[str, JointConfig], where: object
) -> str:
    """Text of a servo file with other values of the bus and of each joint's `KEYS`."""
    root = ros_path(text)
    old = ServoConfig.parse(parse_yaml(text, str(where)), str(where))
    values: dict[tuple[str, ...], Any] = {
        (*root, "bus", key): v for key, v in bus.items() if v != getattr(old.bus, key)
    }
    for name, joint in joints.items():
        for key in KEYS:
            if getattr(joint, key) != getattr(old.joints[name], key):
                place = (*root, "joints", name, key)
                values[place] = getattr(joint, key)
    made = edited(text, values, where)
    if ServoConfig.parse(parse_yaml(made, str(where)), str(where)).joints != joints:
        raise InputError(where, "joints", "cannot be edited", "a line or a block for each joint")
    return made


def write_servos(
    folder: Path, text: str, joints: Mapping[str, JointConfig], facts: Mapping[str, Any]
) -> None:
    """Write the servo file in one step, and what was measured."""
    write_text(folder / SERVOS, text)
    note_measured(folder, SERVOS, "servo setup", servo_values(joints), facts)


def servo_values(joints: Mapping[str, JointConfig]) -> dict[str, Any]:
    """What a setup finds of each joint, by dotted name."""
    return {
        f"joints.{name}.{key}": getattr(joint, key)
        for name, joint in joints.items()
        for key in KEYS
    }
