"""``longarm find-port``, ``servo scan``, ``servo set-id`` and ``servo setup``."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_table, progress
from longarm_comp.cli.signals import ask, by_name, go_on, handle_signals, numbers_by_name
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus.registry import FoundServo, Scan
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_joint import JointConfig
    from longarm_comp.devices.servo_setup import ServoSetup


@click.command()
@options.servo_line
@click.option(
    "--timeout", default=0.02, type=click.FloatRange(0.001, 1.0), help="Patience with one id, s."
)
@options.as_json
def scan(port: str | None, **line: Any) -> None:
    """List the servos on a bus: id, model, firmware, ids that two servos share, alarms, and what
    their memory holds that is not as from the factory (--json: all that matters to commands).

    Asks every id alone. Without --protocol and --baud it tries the usual ones, one after the other,
    until a servo answers. Nothing moves and nothing is written. The exit code is 3 if no servo
    answers or two have the same id.

    \b
    Examples:
      longarm servo scan --port /dev/ttyUSB0
      longarm servo scan --port /dev/ttyUSB0 --protocol feetech --baud 1000000 --ids 1-20 --json
    """
    from longarm_comp.devices.setup_journal import SetupJournal

    found = _find_servos("servo scan", port, **line)
    print_json(asdict(found))
    _show_servos(found)
    left = SetupJournal(found.port, found.protocol)
    if ids_left := sorted(left.read()):
        note(
            f"a setup was broken off: servos {ids_left} have not stored again what they had "
            f"({left.path}); the next setup or start of the driver sees to it"
        )
    if all(servo.model for servo in found.servos):
        note("next: longarm servo setup DIR writes each servo's model, zero and direction")


def _find_servos(
    command: str,
    port: str | None,
    protocol: str | None,
    baud: int | None,
    ids: str,
    timeout: float = 0.02,
    known: str | None = None,
    expected: Collection[int] = (),
) -> Scan:
    """Return the servos that answer. Without a port the user is asked for it.

    Args:
        command: name of the command, for error messages.
        ids: ids to ask, such as ``1-20`` or ``1,2``.
        timeout: longest wait per id, s.
        known: port in the servo file, the default of the question.
        expected: ids in the servo file.

    Raises:
        JobError: no servo answers.
    """
    from longarm_comp.devices.servo_bus.registry import list_usable_ports, scan_line

    if port is None:
        there = list_usable_ports()
        for device, description in there:
            note(f"{device}  {description}")
        default = there[0][0] if len(there) == 1 else known
        port = str(ask(command, "--port", "serial port", "a serial port", default=default))
    with progress("scan") as tell:
        found = scan_line(port, protocol, baud, _parse_ids(ids), timeout, tell, expected)
    if found is None:
        raise JobError(
            f"no servo answers on {port}: is the bus powered, are data and ground connected, is it "
            "another baud rate (--baud) or another program's port?",
            protocol=protocol or "all",
            baud=baud or "the usual ones",
            ids=ids,
        )
    return found


def _show_servos(found: Scan) -> None:
    """Print the servos found; raise `JobError` where two answer with the same id."""
    rows = []
    for s in found.servos:
        clash = "two servos with this id, or a bad line" if s.clash else ""
        alarm = f"alarm: {s.alarm}" if s.alarm else ""
        said = "; ".join(filter(None, (clash, alarm, s.told)))
        rows.append((s.servo_id, s.model or f"unknown model {s.model_number}", s.firmware, said))
    title = f"{found.port}: {found.protocol}, {found.baudrate} bit/s"
    print_table(title, ("id", "model", "firmware", ""), rows)
    for s in found.servos:
        if not s.model and not s.clash:
            note(f"next: {_describe_unknown(s, found.protocol)}")
    if found.clashes:
        raise JobError(
            "answers are damaged or doubled: connect these servos one at a time and give each its "
            "own id, or check the cable",
            ids=list(found.clashes),
        )


def _describe_unknown(servo: FoundServo, protocol: str) -> str:
    from longarm_comp.devices.servo_bus.registry import protocols

    known = ", ".join(model.name for model in protocols()[protocol].models)
    return (
        f"servo {servo.servo_id} is of the unknown model {servo.model_number} (known: {known}): "
        "use one of these, or describe it in a file of yours (docs/add_a_protocol.md)"
    )


def _parse_ids(text: str) -> Sequence[int]:
    ids: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,3})(?:-(\d{1,3}))?\s*", part)
        ends = [int(v or found[1]) for v in found.groups()] if found else [1, 0]
        if not 0 <= ends[0] <= ends[1] <= 252:
            raise InputError("servo scan", "--ids", text, "ids 0 to 252, for instance 1-20 or 1,2")
        ids += range(ends[0], ends[1] + 1)
    return sorted(set(ids))


@click.command("set-id")
@click.argument("servo_id", type=int, metavar="ID")
@options.servo_line
def set_id(servo_id: int, port: str | None, **line: Any) -> None:
    """Give the only connected servo the id ID; the servo keeps it without power.

    New servos all have the id 1. Connect one alone, give it its id, disconnect it, connect the
    next. Refused while an arm on this port is stopped or held: its torque would go off.

    \b
    Example:
      longarm servo set-id 3 --port /dev/ttyUSB0
    """
    from longarm_comp.devices.servo_bus.registry import change_servo_id
    from longarm_comp.devices.state_folder import state_folder
    from longarm_comp.devices.stop_latch import refuse_under_stop

    found = _find_servos("servo set-id", port, **line)
    refuse_under_stop(state_folder(), [found.port])
    old = change_servo_id(found, servo_id)
    note(f"servo {old} is servo {servo_id} now: write it on the servo")
    note("next: connect the next servo alone; when all are done, longarm servo setup DIR")


@click.command("find-port")
def find_port() -> None:
    """Find the serial port of the servo bus: unplug the bus when asked, and the port that
    disappears is it.

    \b
    Example:
      longarm find-port
    """
    from longarm_comp.devices.servo_bus.registry import list_usable_ports

    there = dict(list_usable_ports())
    if not there:
        raise JobError(
            "no serial port: is the adapter plugged in, with a cable that carries data? "
            "`sudo dmesg | tail` says what the system sees"
        )
    for device, description in there.items():
        note(f"{device}  {description}")
    go_on("find-port", False, "Unplug the bus's USB cable.")
    gone = sorted(set(there) - set(dict(list_usable_ports())))
    if len(gone) != 1:
        raise JobError("no port disappeared, or several did: unplug this cable alone", went=gone)
    go_on("find-port", False, "Plug it in again.")
    note(f"next: longarm servo scan --port {gone[0]}")
    click.echo(gone[0])


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
    from longarm_comp.arm_folder.parameter_file import read_parameters
    from longarm_comp.arm_folder.servos import KEYS, SERVOS, with_joints
    from longarm_comp.core.files import write_text
    from longarm_comp.devices.servo_bus.registry import open_bus
    from longarm_comp.devices.servo_check import check_reach
    from longarm_comp.devices.servo_config import ServoConfig
    from longarm_comp.devices.servo_setup import ServoSetup, show_value, zero_from_pose
    from longarm_comp.devices.state_folder import state_folder
    from longarm_comp.devices.stop_latch import refuse_under_stop

    file, wait = folder / SERVOS, partial(go_on, _COMMAND, yes)
    if not file.is_file():
        raise InputError(file, "servo file", "missing", "`longarm init` makes it")
    config = ServoConfig.load(file)
    held, directions, bus = (
        _held_pose(config, pose),
        _given_directions(config, direction),
        config.bus,
    )
    known = {joint.servo_id for joint in config.joints.values()}
    found = _find_servos(_COMMAND, port, known=bus.port, expected=known, **line)
    stops = Path(read_parameters(file).get("state") or state_folder())
    check = partial(refuse_under_stop, stops, {found.port, bus.port}, folder / "arm.yaml")
    check()
    _show_servos(found)
    blind = _on_the_bus(config, found)
    wait("The torque goes off: hold or support the arm.")
    servo_bus = open_bus(
        found.protocol,
        found.port,
        found.baudrate,
        {joint.servo_id: joint.servo for joint in blind.values()},
        bus.reply_timeout_s,
        bus.retries,
    )
    with closing(servo_bus), ServoSetup(servo_bus, blind, check).safely() as bench:
        for text in bench.said:
            note(text)
        said = ", ".join(f"{name} {show_value(blind[name], v)}" for name, v in held.items())
        wait(f"Put the arm into this pose and hold it still (another: --pose): {said}.")
        rest = bench.rest()
        unknown = [name for name in blind if name not in directions]
        if unknown:
            wait("The torque goes on; each joint makes a small move. Stand clear.")
            bench.hold()
            directions |= {name: _ask_direction(bench, name) for name in unknown}
            wait("The torque goes off again: hold or support the arm.")
            bench.let_go()
        joints = {}
        for name, joint in blind.items():
            kept = bench.memory[name]
            turned = joint.with_values(direction=directions[name], stored=kept.placing)
            zero = zero_from_pose(turned, rest[name], held[name])
            joints[name] = turned.with_values(zero_ticks=zero)
            check_reach(name, joints[name], kept)
        line_found = {key: getattr(found, key) for key in ("protocol", "port", "baudrate")}
        text = with_joints(file.read_text("utf-8"), line_found, joints, file)
        wait(f"{file} will be written.")
        write_text(file, text)
        bench.keep()
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
        (name, j.servo_id, signs[j.direction], f"{j.zero_ticks:g}", show_value(j, reads[name]))
        for name, j in joints.items()
    ]
    header = ("joint", "id", "direction", "zero_ticks", "now")
    print_table(f"{file}, read back", header, rows)
    note(f"next: longarm check {folder}")


def _held_pose(config: ServoConfig, pose: Sequence[str]) -> dict[str, float]:
    """Return the joint values, rad or m, of the pose that the user holds.

    Joints not in ``pose`` are at 0, or at the limit nearest to it.
    """
    from longarm_comp.devices.servo_setup import hand_unit

    joints = config.joints
    held = {name: min(max(0.0, joint.lower), joint.upper) for name, joint in joints.items()}
    form = "JOINT=NUMBER, deg or mm"
    for name, value in numbers_by_name(_COMMAND, "--pose", pose, form, list(joints)).items():
        held[name] = value * hand_unit(joints[name])[0]
    return held


def _given_directions(config: ServoConfig, direction: Sequence[str]) -> dict[str, int]:
    """Return the directions, +1 or -1, that are given by option, by joint.

    Raises:
        InputError: an invalid direction, or one is missing and there is no terminal to ask on.
    """
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
            raise JobError(f"{name}: {_describe_unknown(servo, found.protocol)}")
        if servo.model != joint.model:
            note(f"{name}: servo {servo.servo_id} is a {servo.model}, and the file will say so")
        joints[name] = joint.with_values(model=servo.model)
    return joints


def _ask_direction(setup: ServoSetup, name: str) -> int:
    """Move a joint a little, ask the user which way it went, and return its direction, +1 or -1."""
    text = "which way did it go, by arm.yaml? (another joint moved: Ctrl-C, correct servo_id)"
    kind, said = click.Choice([*_SIGNS, "again"]), "again"
    while said == "again":
        with setup.nudge(name) as grew:
            allowed = ", ".join(kind.choices)
            said = ask(
                _COMMAND, "--direction", f"{name}: {text}", allowed, default="again", type=kind
            )
    return grew * _SIGNS[said]
