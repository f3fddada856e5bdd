"""``longarm servo set-id``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command("set-id")
@click.argument("servo_id", type=int, metavar="ID")
@options.port
@options.protocol
@options.baud
@options.bus_ids
def command(
    servo_id: int, port: str | None, protocol: str | None, baud: int | None, ids: str
) -> None:
    """Give the one servo that is connected the id ID; it keeps it without power.

    New servos all have the id 1. Connect one alone, give it its id, take it off, connect the next.

    \b
    Example:
      longarm servo set-id 3 --port /dev/ttyUSB0
    """
    from longarm_comp.cli.dialogue import Dialogue
    from longarm_comp.cli.output import note
    from longarm_comp.cli.servo_scan import asked_port, scanned
    from longarm_comp.devices.servo_bus.scan import renumber

    found = scanned(asked_port(Dialogue("servo set-id"), port, None), protocol, baud, ids)
    old = renumber(found, servo_id)
    note(f"servo {old} is servo {servo_id} now: write it on the servo")
    note("next: connect the next servo alone; when all are done, longarm servo setup DIR")
