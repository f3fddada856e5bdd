"""``longarm servo scan``, ``servo set-id`` and ``find-port``: what is on the servo bus."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_table, progress
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.cli.dialogue import Dialogue
    from longarm_comp.devices.servo_bus import Scan


@click.command()
@options.servo_line
@click.option(
    "--timeout", default=0.02, type=click.FloatRange(0.001, 1.0), help="Patience with one id, s."
)
@options.as_json
def scan(port: str | None, as_json: bool, **line: Any) -> None:
    """List the servos on a bus: id, model, firmware, ids that two servos share.

    Asks every id alone. Without --protocol and --baud it tries the usual ones, one after the other,
    until a servo answers. Nothing moves and nothing is written. The exit code is 3 if no servo
    answers or two have the same id.

    \b
    Examples:
      longarm servo scan --port /dev/ttyUSB0
      longarm servo scan --port /dev/ttyUSB0 --protocol feetech --baud 1000000 --ids 1-20 --json
    """
    from longarm_comp.cli.dialogue import Dialogue

    found = scanned(asked_port(Dialogue("servo scan"), port, None), **line)
    if as_json:
        print_json(asdict(found))
    else:
        show(found)
    refuse_clashes(found)


def asked_port(dialogue: Dialogue, port: str | None, known: str | None) -> str:
    """The port, asked where it is not given. ``known``: what the servo file has."""
    from longarm_comp.devices.servo_bus import usable_ports

    if port is not None:
        return port
    found = usable_ports()
    for device, description in found:
        note(f"{device}  {description}")
    default = found[0][0] if len(found) == 1 else known
    return dialogue.ask("--port", "serial port", "a serial port", default)


def scanned(
    port: str, protocol: str | None, baud: int | None, ids: str, timeout: float = 0.02
) -> Scan:
    """The servos on a port, with progress."""
    from longarm_comp.devices.servo_bus import scan_line

    with progress("scan") as tell:
        found = scan_line(port, protocol, baud, _ids(ids), timeout, tell)
    if found is None:
        raise JobError(
            f"no servo answers on {port}: is the bus powered, are data and ground connected, is it "
            "another baud rate (--baud) or another program's port?",
            protocol=protocol or "all", baud=baud or "the usual ones", ids=ids,
        )  # fmt: skip
    return found


def show(found: Scan, on_stderr: bool = False) -> None:
    """The servos as a table."""
    rows = [
        (s.servo_id, s.model or f"unknown model {s.model_number}", s.firmware,
         "two servos with this id, or a bad line" if s.clash else "")
        for s in found.servos
    ]  # fmt: skip
    title = f"{found.port}: {found.protocol}, {found.baudrate} bit/s"
    print_table(title, ("id", "model", "firmware", ""), rows, on_stderr)


def refuse_clashes(found: Scan) -> None:
    """Raise JobError where ids are not unique."""
    if found.clashes:
        raise JobError(
            "answers are damaged or doubled: connect these servos one at a time and give each its "
            "own id, or check the cable",
            ids=list(found.clashes),
        )


def _ids(text: str) -> Sequence[int]:
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
    next.

    \b
    Example:
      longarm servo set-id 3 --port /dev/ttyUSB0
    """
    from longarm_comp.cli.dialogue import Dialogue
    from longarm_comp.cli.output import note
    from longarm_comp.devices.servo_bus.registry import renumber

    found = scanned(asked_port(Dialogue("servo set-id"), port, None), **line)
    old = renumber(found, servo_id)
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
    from longarm_comp.cli.dialogue import Dialogue
    from longarm_comp.core.errors import JobError
    from longarm_comp.devices.servo_bus import usable_ports

    there = dict(usable_ports())
    if not there:
        raise JobError(
            "no serial port: is the adapter plugged in, with a cable that carries data? "
            "`sudo dmesg | tail` says what the system sees"
        )
    for device, description in there.items():
        note(f"{device}  {description}")
    dialogue = Dialogue("find-port")
    dialogue.go_on("Unplug the bus's USB cable.")
    gone = sorted(set(there) - set(dict(usable_ports())))
    if len(gone) != 1:
        raise JobError("no port disappeared, or several did: unplug this cable alone", went=gone)
    dialogue.go_on("Plug it in again.")
    note(f"next: longarm servo scan --port {gone[0]}")
    click.echo(gone[0])
