"""``longarm servo setup``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_table
from longarm_comp.cli.servo import (
    describe_unknown,
    find_servos,
    own_state,
    refuse_stopped,
    show_servos,
)
from longarm_comp.cli.signals import ask, by_name, go_on, handle_signals, numbers_by_name
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus.registry import Scan
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
@handle_signals(signal.default_int_handler)
def setup(
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
    as it was. While the arm is stopped or held nothing is touched.

    \b
    Examples:
      longarm servo setup my_arm
      longarm servo setup my_arm --port /dev/ttyUSB0 --yes --pose joint2=30 \\
        --direction joint1=+ --direction joint2=-
    """
    from longarm_comp.arm_folder.measured import note_measured
    from longarm_comp.arm_folder.servos import KEYS, SERVOS, with_joints
    from longarm_comp.core.files import write_text
    from longarm_comp.devices.kept_turns import keep_turns
    from longarm_comp.devices.servo_bus.registry import open_bus
    from longarm_comp.devices.servo_check import check_reach
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_setup import ServoSetup, hand_unit, show_value
    from longarm_comp.devices.setup_journal import SetupJournal
    from longarm_comp.devices.state_folder import state_folder

    file, wait, state = folder / SERVOS, partial(go_on, _COMMAND, yes), own_state(folder)
    config = ServoConfig.load(file)
    bus, form = config.bus, "JOINT=NUMBER, deg or mm"
    held = {name: joint.home for name, joint in config.joints.items()}
    for name, value in numbers_by_name(_COMMAND, "--pose", pose, form, list(held)).items():
        held[name] = value * hand_unit(config.joints[name])[0]
    directions = _given_directions(config, direction)
    known = {joint.servo_id for joint in config.joints.values()}
    found = find_servos(_COMMAND, port, known=bus.port, expected=known, **line)
    check = partial(refuse_stopped, state, {found.port, bus.port}, folder)
    check()
    show_servos(found)
    blind = _on_the_bus(config, found)
    wait("The torque goes off: hold or support the arm.")
    servos = {joint.servo_id: joint.servo for joint in blind.values()}
    patience = bus.reply_timeout_s, bus.retries
    servo_bus = open_bus(found.protocol, found.port, found.baudrate, servos, *patience)
    journal = SetupJournal(state, folder / "arm.yaml", servo_bus)
    with closing(servo_bus), ServoSetup(servo_bus, blind, journal, check).safely() as bench:
        for text in bench.said:
            note(text)
        zeros = _find_zeros(bench, blind, held, directions, yes)
        joints = {
            name: joint.with_values(
                direction=directions[name],
                stored=bench.memory[name].placing,
                zero_ticks=zeros[name],
            )
            for name, joint in blind.items()
        }
        for name, joint in joints.items():
            check_reach(name, joint, bench.memory[name])
        line_found = {key: getattr(found, key) for key in ("protocol", "port", "baudrate")}
        text = with_joints(file.read_text("utf-8"), line_found, joints, file)
        wait(f"{file} will be written.")
        write_text(file, text)
        bench.keep()
    note_measured(folder, SERVOS, "servo setup", {"zero": "pose"})
    written = ServoConfig.load(file)  # as the driver will read it
    with closing(written.open_bus()) as bus_now:
        states = bus_now.read(list(written.ids.values()))
    keep_turns(state_folder(state), folder / "arm.yaml", written, states)
    reads = {n: j.to_si(states[j.servo_id].position_ticks) for n, j in written.joints.items()}
    facts = {
        name: {key: getattr(joint, key) for key in KEYS} | {"now": reads[name]}
        for name, joint in joints.items()
    }
    print_json({"file": file, **line_found, "joints": facts})
    signs = {number: sign for sign, number in _SIGNS.items()}
    rows = [
        (name, j.servo_id, signs[j.direction], f"{j.zero_ticks:g}", show_value(j, reads[name]))
        for name, j in joints.items()
    ]
    header = ("joint", "id", "direction", "zero_ticks", "now")
    print_table(f"{file}, read back", header, rows)
    note(f"next: longarm check {folder}")


def _given_directions(config: ServoConfig, direction: Sequence[str]) -> dict[str, int]:
    """Return the directions given by option, +1 or -1; others need a terminal to ask on."""
    form = "JOINT=+ or JOINT=-"
    given = by_name(_COMMAND, "--direction", direction, form, list(config.joints))
    for text in given.values():
        if text not in _SIGNS:
            raise InputError(_COMMAND, "--direction", text, form)
    blind = [name for name in config.joints if name not in given]
    if blind and not sys.stdin.isatty():
        allowed = f"+ or - of {', '.join(blind)}; or a terminal to ask on"
        raise InputError(_COMMAND, "--direction", "missing", allowed)
    return {name: _SIGNS[text] for name, text in given.items()}


def _on_the_bus(config: ServoConfig, found: Scan) -> dict[str, JointConfig]:
    on_bus = {servo.servo_id: servo for servo in found.servos}
    joints = {}
    for name, joint in config.joints.items():
        servo = on_bus.get(joint.servo_id)
        if servo is None:
            raise JobError(
                f"servo {joint.servo_id} of {name} is not on the bus: longarm servo set-id, or "
                "correct servo_id",
                found=list(on_bus),
            )
        if not servo.model:
            raise JobError(f"{name}: {describe_unknown(servo, found.protocol)}")
        if servo.model != joint.model:
            note(f"{name}: servo {servo.servo_id} is a {servo.model}, and the file will say so")
        joints[name] = joint.with_values(model=servo.model)
    return joints


def _find_zeros(
    bench: ServoSetup,
    joints: Mapping[str, JointConfig],
    held: Mapping[str, float],
    directions: dict[str, int],
    yes: bool,
) -> dict[str, float]:
    """Return the joints' zeros, ticks, from a pose that the user holds; ask for it until they fit.

    A zero fits if it is in the turn from which the servo counts after power-on.

    Args:
        held: the pose, rad or m.
        directions: +1 or -1 by joint; those left out are asked for and added.
    """
    from longarm_comp.devices.servo_setup import describe_power_on, show_value, zero_from_pose

    wait = partial(go_on, _COMMAND, yes)
    said = ", ".join(f"{name} {show_value(joints[name], v)}" for name, v in held.items())
    while True:
        wait(f"Put the arm into this pose and hold it still (another: --pose): {said}.")
        rest = bench.rest()
        unknown = [name for name in joints if name not in directions]
        if unknown:
            wait("The torque goes on; each joint makes a small move. Stand clear.")
            bench.hold()
            directions |= {name: _ask_direction(bench, name) for name in unknown}
            wait("The torque goes off again: hold or support the arm.")
            bench.let_go()
        zeros: dict[str, float] = {}
        elsewhere: dict[str, JointConfig] = {}
        for name, joint in joints.items():
            zeros[name] = zero_from_pose(joint, directions[name], rest[name], held[name])
            low, high = joint.zero_range(directions[name], bench.memory[name].placing)
            if not low <= zeros[name] <= high:
                elsewhere[name] = joint
        if not elsewhere:
            return zeros
        if yes:
            raise JobError(f"{describe_power_on(elsewhere)}; without --yes, setup waits for that")
        wait(f"{describe_power_on(elsewhere)}.")


def _ask_direction(setup: ServoSetup, name: str) -> int:
    """Move a joint a little, ask the user which way it went, and return its direction, +1 or -1."""
    text = "which way did it go, by arm.yaml? (another joint moved: Ctrl-C, correct servo_id)"
    kind, question, said = click.Choice([*_SIGNS, "again"]), f"{name}: {text}", "again"
    while said == "again":
        with setup.nudge(name) as grew:
            allowed = ", ".join(kind.choices)
            said = ask(_COMMAND, "--direction", question, allowed, default="again", type=kind)
    return grew * _SIGNS[said]
