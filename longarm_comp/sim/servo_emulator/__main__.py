"""``python -m longarm_comp.sim.servo_emulator``: an emulated servo bus as a process."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path

import click

from longarm_comp.core.errors import LongarmError
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import MotorSpec
from longarm_comp.sim.servo_emulator.wires import wires


@click.command()
@click.option("--config", required=True, type=click.Path(), help="The servo driver's YAML.")
@click.option("--link", required=True, type=click.Path(), help="Symbolic link to make to the port.")
@click.option("--protocol", type=click.Choice(sorted(wires())), help="Instead of the file's.")
@click.option("--speed", default=3000.0, help="No-load speed, ticks/s.", show_default=True)
@click.option("--lag", default=0.03, help="Time constant near the goal, s.", show_default=True)
@click.option("--dead-band", default=0.0, help="Rest this short of a goal, ticks.")
@click.option("--wire-time", type=int, help="Take as long as this baud rate does.")
def main(
    config: str,
    link: str,
    protocol: str | None,
    speed: float,
    lag: float,
    dead_band: float,
    wire_time: int | None,
) -> None:
    """Emulate the servo bus that CONFIG describes, until SIGINT or SIGTERM."""
    done = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: done.set())
    try:
        arm = read_arm(config)
        spec = MotorSpec(max_speed_ticks_s=speed, lag_s=lag, dead_band_ticks=dead_band)
        emulator = ServoEmulator(
            protocol or arm.protocol,
            arm.start_ticks(),
            spec,
            link=Path(link),
            baudrate=wire_time,
        )
        with emulator:
            click.echo(f"{emulator.protocol} servos {sorted(arm.start_ticks())} at {link}")
            sys.stdout.flush()
            done.wait()
    except LongarmError as error:
        click.echo(str(error), err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
