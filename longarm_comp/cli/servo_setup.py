"""``longarm servo setup``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.dialogue import ask, by_name, ended_by_signals, go_on
from longarm_comp.cli.output import note, print_json, print_table
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus import Scan
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_joint import JointConfig
    from longarm_comp.devices.servo_setup import ServoSetup

_COMMAND = "servo setup"
_SIGNS = {"+": 1, "-": -1}


@click.command()
@options.folder
@options.servo_line
@click.option(
    "--pose", multiple=True, metavar="JOINT=VALUE", help="Held pose, deg or mm. Default: 0."
)
@click.option(
    "--direction",
    multiple=True,
    metavar="JOINT=+|-",
    help="+ if the ticks grow with the joint value, else -.",
)
@options.flag("--yes", "Do not wait at each step: the arm is held or supported.")
@options.as_json
@ended_by_signals()
def command(
    folder: Path,
    port: str | None,
    pose: Sequence[str],
    direction: Sequence[str],
    yes: bool,
    **line: Any,
) -> None:
    """Find zeros and directions of DIR's servos, and write DIR/servo_driver.yaml.

    The steps are: scan for servos; switch the torque off; take the zeros from a pose that you hold;
    move each joint by 5 degrees (a slide by 5 mm) and ask which way it went. Then the file is
    written in one step, read again, and the joints' values are shown. Every question is also an
    option. The torque is off at the end and after an interruption; an interruption leaves the file
    as it was.

    \b
    Examples:
      longarm servo setup my_arm
      longarm servo setup my_arm --port /dev/ttyUSB0 --yes --pose joint2=30 \\
        --direction joint1=+ --direction joint2=-
    """
    from longarm_comp.arm_folder.measured import note_measured
    from longarm_comp.arm_folder.servos import KEYS, SERVOS, with_joints
    from longarm_comp.cli.servo import asked_port, refuse_clashes, scanned, show
    from longarm_comp.core.files import write_text
    from longarm_comp.devices.servo_bus import open_bus
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_setup import ServoSetup, shown, zero_from_pose

    file, wait = folder / SERVOS, partial(go_on, _COMMAND, yes)
    if not file.is_file():
        raise InputError(file, "servo file", "missing", "`longarm init` makes it")
    config = ServoConfig.load(file)
    held, directions, bus = _held(config, pose), _given(config, direction), config.bus
    found = scanned(asked_port(_COMMAND, port, bus.port), **line)
    show(found, on_stderr=True)
    refuse_clashes(found)
    blind = _on_the_bus(config, found)
    wait("The torque goes off: hold or support the arm.")
    servo_bus = open_bus(
        found.protocol, found.port, found.baudrate,
        {joint.servo_id: joint.servo for joint in blind.values()},
        bus.reply_timeout_s, bus.retries,
    )  # fmt: skip
    with closing(servo_bus), ServoSetup(servo_bus, blind).safely() as setup:
        said = ", ".join(f"{name} {shown(blind[name], v)}" for name, v in held.items())
        wait(f"Put the arm into this pose and hold it still (another: --pose): {said}.")
        rest = setup.rest()
        unknown = [name for name in blind if name not in directions]
        if unknown:
            wait("The torque goes on; each joint makes a small move. Stand clear.")
            setup.hold()
            directions |= {name: _nudged(setup, name) for name in unknown}
            wait("The torque goes off again: hold or support the arm.")
    joints = {}
    for name, joint in blind.items():
        turned = joint.having(direction=directions[name])
        joints[name] = turned.having(zero_ticks=zero_from_pose(turned, rest[name], held[name]))
    line_found = {key: getattr(found, key) for key in ("protocol", "port", "baudrate")}
    text = with_joints(file.read_text("utf-8"), line_found, joints, file)
    wait(f"{file} will be written.")
    write_text(file, text)
    note_measured(folder, SERVOS, "servo setup", {"zero": "pose"})
    written = ServoConfig.load(file)  # as the driver will read it
    with closing(written.open_bus()) as bus_now:
        states = bus_now.read(list(written.ids.values()))
    reads = {n: j.to_si(states[j.servo_id].position_ticks) for n, j in written.joints.items()}
    facts = {
        name: {key: getattr(joint, key) for key in KEYS} | {"now": reads[name]}
        for name, joint in joints.items()
    }
    print_json({"file": file, **line_found, "joints": facts})
    signs = {number: sign for sign, number in _SIGNS.items()}
    rows = [
        (name, j.servo_id, signs[j.direction], f"{j.zero_ticks:g}", shown(j, reads[name]))
        for name, j in joints.items()
    ]
    header = ("joint", "id", "direction", "zero_ticks", "now")
    print_table(f"{file}, read back", header, rows)
    note(f"next: longarm check {folder}")


def _held(config: ServoConfig, pose: Sequence[str]) -> dict[str, float]:
    """Joint values of the held pose, rad or m."""
    from longarm_comp.devices.servo_setup import hand_unit

    joints = config.joints
    held = {name: min(max(0.0, joint.lower), joint.upper) for name, joint in joints.items()}
    for name, text in by_name(_COMMAND, "--pose", pose, list(joints)).items():
        held[name] = _number(text) * hand_unit(joints[name])[0]
    return held


def _given(config: ServoConfig, direction: Sequence[str]) -> dict[str, int]:
    """+1 or -1 of the joints whose direction is given: of all where nobody is there to be asked."""
    given = by_name(_COMMAND, "--direction", direction, list(config.joints))
    for text in given.values():
        if text not in _SIGNS:
            raise InputError(_COMMAND, "--direction", text, "JOINT=+ or JOINT=-")
    blind = [name for name in config.joints if name not in given]
    if blind and not sys.stdin.isatty():
        allowed = f"+ or - of {', '.join(blind)}; or a terminal to ask on"
        raise InputError(_COMMAND, "--direction", "missing", allowed)
    return {name: _SIGNS[text] for name, text in given.items()}


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e6:
        raise InputError(_COMMAND, "--pose", text, "JOINT=NUMBER, deg or mm")
    return value


def _on_the_bus(config: ServoConfig, found: Scan) -> dict[str, JointConfig]:
    """The joints with the models that their ids have on the bus."""
    on_bus = {servo.servo_id: servo for servo in found.servos}
    joints = {}
    for name, joint in config.joints.items():
        servo = on_bus.get(joint.servo_id)
        if servo is None:
            raise JobError(
                f"servo {joint.servo_id} of {name} is not on the bus: longarm servo set-id, or "
                "correct servo_id", found=list(on_bus),
            )  # fmt: skip
        if not servo.model:
            number = servo.model_number
            raise JobError(
                f"servo {servo.servo_id} of {name} is of an unknown model", number=number
            )
        joints[name] = joint.having(model=servo.model)
    return joints


def _nudged(setup: ServoSetup, name: str) -> int:
    """Direction of a joint: it is nudged, and the user says which way it went."""
    text = "which way did it go, by arm.yaml? (another joint moved: Ctrl-C, correct servo_id)"
    kind, said = click.Choice([*_SIGNS, "again"]), "again"
    while said == "again":
        with setup.nudged(name) as grew:
            allowed = ", ".join(kind.choices)
            said = ask(
                _COMMAND, "--direction", f"{name}: {text}", allowed, default="again", type=kind
            )
    return grew * _SIGNS[said]
