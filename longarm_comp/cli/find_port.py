"""``longarm find-port``."""

from __future__ import annotations

import click

from longarm_comp.cli.output import note


@click.command("find-port")
def command() -> None:
    """Find the servo bus among the serial ports: unplug it when asked, and see which one goes.

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
        raise JobError("not one port went away: unplug this cable alone", went=gone)
    dialogue.go_on("Plug it in again.")
    note(f"next: longarm servo scan --port {gone[0]}")
    click.echo(gone[0])
