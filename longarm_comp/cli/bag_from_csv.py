"""``longarm bag from-csv``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note


@click.command()
@options.arm
@options.session
@options.output(None, "Bag folder to write.", outputs.left_to_the_command)
@click.option(
    "--storage", type=click.Choice(["mcap", "sqlite3"]), default="mcap", show_default=True
)
@click.option("--namespace", default="", help="Put before every topic.")
def command(
    arm: Path, session: Path, output: Path, storage: Literal["mcap", "sqlite3"], namespace: str
) -> None:
    """Write SESSION (CSV) as a bag of the robot's own topics.

    \b
    Example:
      longarm bag from-csv arm.yaml samples.csv -o session_bag
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.sessions.bag_write import write_bag
    from longarm_comp.sessions.read import read_session

    declared = Arm.load(arm)
    read = read_session(session, declared)
    write_bag(read, output, declared, storage, namespace)
    note(f"{len(read)} rows in {output}")
