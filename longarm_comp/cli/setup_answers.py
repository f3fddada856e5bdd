"""Answers of ``longarm servo setup`` as given by flags, checked before anything is touched."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from longarm_comp.arm_folder.servos import SERVOS
from longarm_comp.cli.dialogue import Dialogue, attended, by_name
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.servo_bus import Scan
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_joint import JointConfig
from longarm_comp.devices.servo_setup import hand_unit

_COMMAND = "servo setup"
_SIGNS = {"+": 1, "+1": 1, "-": -1, "-1": -1}
_RANGE = re.compile(r"(-?[\d.]+)\.\.(-?[\d.]+)")


@dataclass(frozen=True)
class SetupAnswers:
    """What is known before the first question.

    Attributes:
        flags: as given: port, protocol, baud, ids (to ask), sweep_s, no_sweep, zero, nudge (deg or
            mm), yes.
        ids: servo id of joints, where given.
        pose: joint values of the held pose, rad or m, where given.
        stops: joint values at the ends of the sweep, rad or m, where given.
        directions: +1 or -1 of joints, where given; filled in by the nudges.
    """

    dialogue: Dialogue
    config: ServoConfig
    flags: Mapping[str, Any]
    ids: dict[str, int]
    pose: dict[str, float]
    stops: dict[str, tuple[float, float]]
    directions: dict[str, int]

    @classmethod
    def of(
        cls,
        folder: Path,
        *,
        id_of: Sequence[str],
        pose: Sequence[str],
        stops: Sequence[str],
        direction: Sequence[str],
        **flags: Any,
    ) -> SetupAnswers:
        """From the flags."""
        file = folder / SERVOS
        if not file.is_file():
            raise InputError(file, "servo file", "missing", "`longarm init` makes it")
        config = ServoConfig.load(file)
        joints = config.joints

        def named(flag: str, given: Sequence[str]) -> dict[str, str]:
            return by_name(_COMMAND, flag, given, list(joints))

        made = cls(
            Dialogue(_COMMAND, flags["yes"]), config, flags,
            {n: _id(v) for n, v in named("--id", id_of).items()},
            {n: _number("--pose", v) * hand_unit(joints[n])[0]
             for n, v in named("--pose", pose).items()},
            {n: _range(v, hand_unit(joints[n])[0]) for n, v in named("--stops", stops).items()},
            {n: _sign(v) for n, v in named("--direction", direction).items()},
        )  # fmt: skip
        for flag, size in (("--nudge", flags["nudge"]), ("--sweep-s", flags["sweep_s"])):
            if size is not None and not 0.0 < size < math.inf:
                raise InputError(_COMMAND, flag, size, "a finite number above 0")
        if flags["no_sweep"] and flags["zero"] == "sweep":
            raise InputError(_COMMAND, "--zero", "sweep", "pose, because there is no sweep")
        made._check_complete()
        return made

    def _check_complete(self) -> None:
        """Without a terminal, refuse before the torque goes off what would be asked later."""
        if attended():
            return
        flags = self.flags
        blind = [name for name in self.config.joints if name not in self.directions]
        for flag, lacks, allowed in (
            ("--port", flags["port"] is None, "a serial port"),
            ("--sweep-s", flags["sweep_s"] is None and not flags["no_sweep"],
             "seconds, or --no-sweep"),
            ("--zero", flags["zero"] is None, "pose or sweep"),
            ("--direction", blind, f"+ or - of {', '.join(blind)}"),
            ("--yes", not flags["yes"], "a yes: the arm is held or supported"),
        ):  # fmt: skip
            if lacks:
                raise InputError(
                    _COMMAND, flag, "missing", f"{allowed}; or a terminal that can ask you"
                )

    def joints_on(self, line: Scan) -> dict[str, JointConfig]:
        """Joints with the ids and models that are on the bus; asked where somebody is there."""
        on_bus = {servo.servo_id: servo for servo in line.servos}
        ids = {name: self.ids.get(name, j.servo_id) for name, j in self.config.joints.items()}
        for name in ids if attended() else ():
            if name not in self.ids:
                text = f"{name}: servo id ({', '.join(map(str, on_bus))})"
                ids[name] = _id(self.dialogue.ask("--id", text, "an id", str(ids[name])))
        joints: dict[str, JointConfig] = {}
        for name, servo_id in ids.items():
            if servo_id in (joint.servo_id for joint in joints.values()):
                allowed = "an id that no other joint has"
                raise InputError(_COMMAND, "--id", f"{name}={servo_id}", allowed)
            if servo_id not in on_bus:
                raise JobError(
                    f"servo {servo_id} of {name} is not on the bus: name another with --id "
                    f"{name}=ID", found=list(on_bus),
                )  # fmt: skip
            if not on_bus[servo_id].model:
                number = on_bus[servo_id].model_number
                raise JobError(f"servo {servo_id} of {name} is of an unknown model", number=number)
            joint = self.config.joints[name]
            joints[name] = joint.having(servo_id=servo_id, model=on_bus[servo_id].model)
        return joints


def _id(text: str) -> int:
    if not text.strip().isdecimal():
        raise InputError(_COMMAND, "--id", text, "JOINT=ID, a whole number")
    return int(text)


def _number(flag: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e6:
        raise InputError(_COMMAND, flag, text, "JOINT=NUMBER, deg or mm")
    return value


def _sign(text: str) -> int:
    if text not in _SIGNS:
        raise InputError(_COMMAND, "--direction", text, "JOINT=+ or JOINT=-")
    return _SIGNS[text]


def _range(text: str, unit: float) -> tuple[float, float]:
    found = _RANGE.fullmatch(text)
    low, high = (_number("--stops", v) for v in found.groups()) if found else (1.0, 0.0)
    if not low < high:
        raise InputError(_COMMAND, "--stops", text, "JOINT=LOW..HIGH, deg or mm, LOW below HIGH")
    return low * unit, high * unit
