"""``longarm find-port``, ``servo scan`` and ``servo set-id``."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_table, progress
from longarm_comp.cli.signals import ask, go_on
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.devices.servo_bus.registry import FoundServo, Scan


@click.command()
@options.servo_line
@options.path_option("--arm", "Folder of the arm: setups that its own state keeps are told, too.")
@options.as_json
def scan(port: str | None, arm: Path | None, **line: Any) -> None:
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
    from longarm_comp.devices.setup_journal import describe_left
    from longarm_comp.devices.state_folder import state_folder

    kept = dict.fromkeys((state_folder(), state_folder(own_state(arm) if arm else "")))
    found = find_servos("servo scan", port, **line)
    print_json(asdict(found))
    show_servos(found)
    for folder in kept:
        for said in describe_left(folder, found.port):
            note(said)
    if all(servo.model for servo in found.servos):
        note("next: longarm servo setup DIR writes each servo's model, zero and direction")


def find_servos(
    command: str,
    port: str | None,
    protocol: str | None,
    baud: int | None,
    ids: str,
    timeout: float,
    known: str | None = None,
    expected: Collection[int] = (),
) -> Scan:
    """Return the servos that answer. Without a port the user is asked for it.

    Args:
        command: name of the command, for error messages.
        known, expected: port (the default of the question) and ids in the servo file.

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
        found = scan_line(port, protocol, baud, _parse_ids(command, ids), timeout, tell, expected)
    if found is None:
        raise JobError(
            f"no servo answers on {port}: is the bus powered, are data and ground connected, is it "
            "another baud rate (--baud) or another program's port?",
            protocol=protocol or "all",
            baud=baud or "the usual ones",
            ids=ids,
        )
    return found


def show_servos(found: Scan) -> None:
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
            note(f"next: {describe_unknown(s, found.protocol)}")
    if found.clashes:
        raise JobError(
            "answers are damaged or doubled: connect these servos one at a time and give each its "
            "own id, or check the cable",
            ids=list(found.clashes),
        )


def describe_unknown(servo: FoundServo, protocol: str) -> str:
    from longarm_comp.devices.servo_bus.registry import protocols

    known = ", ".join(model.name for model in protocols()[protocol].models)
    return (
        f"servo {servo.servo_id} is of the unknown model {servo.model_number} (known: {known}): "
        "use one of these, or describe it in a file of yours (docs/add_a_protocol.md)"
    )


def _parse_ids(command: str, text: str) -> Sequence[int]:
    ids: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,3})(?:-(\d{1,3}))?\s*", part)
        ends = [int(v or found[1]) for v in found.groups()] if found else [1, 0]
        if not 0 <= ends[0] <= ends[1] <= 252:
            raise InputError(command, "--ids", text, "ids 0 to 252, for instance 1-20 or 1,2")
        ids += range(ends[0], ends[1] + 1)
    return sorted(set(ids))


@click.command("set-id")
@click.argument("servo_id", type=int, metavar="ID")
@options.servo_line
@options.path_option("--arm", "Folder of the arm: its own stops count, too.")
def set_id(servo_id: int, port: str | None, arm: Path | None, **line: Any) -> None:
    """Give the only connected servo the id ID; the servo keeps it without power.

    New servos all have the id 1. Connect one alone, give it its id, disconnect it, connect the
    next. Refused while an arm on this port is stopped or held: its torque would go off. An arm
    whose servo_driver.yaml names a folder for stops (state) is known with --arm alone.

    \b
    Examples:
      longarm servo set-id 3 --port /dev/ttyUSB0
      longarm servo set-id 3 --port /dev/ttyUSB0 --arm my_arm
    """
    from longarm_comp.devices.servo_bus.registry import change_servo_id

    state = own_state(arm) if arm else ""
    found = find_servos("servo set-id", port, **line)
    refuse_stopped(state, {found.port}, arm)
    old = change_servo_id(found, servo_id)
    note(f"servo {old} is servo {servo_id} now: write it on the servo")
    note("next: connect the next servo alone; when all are done, longarm servo setup DIR")


def own_state(folder: Path) -> str:
    """Return the folder for stops that an arm's servo file names; empty: the user's."""
    from longarm_comp.arm_folder.parameter_file import read_parameters
    from longarm_comp.arm_folder.servos import SERVOS

    file = folder / SERVOS
    if not file.is_file():
        raise InputError(file, "servo file", "missing", "`longarm init` makes it")
    return str(read_parameters(file).get("state") or "")


def refuse_stopped(state: str, ports: Collection[str], folder: Path | None) -> None:
    """Raise `JobError` if ports, or the arm in a folder, are stopped or held by `own_state`."""
    from longarm_comp.devices.state_folder import state_folder
    from longarm_comp.devices.stop_latch import refuse_under_stop

    refuse_under_stop(state_folder(state), ports, folder and folder / "arm.yaml")


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
