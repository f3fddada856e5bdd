"""``longarm bag to-csv``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json


@click.command()
@options.arm
@click.argument("bag", type=click.Path(path_type=Path), metavar="BAG")
@options.output("samples.csv", "Session to write.", outputs.SESSION)
@click.option("--namespace", help="Which arm, where the bag holds several.")
@options.as_json
def command(arm: Path, bag: Path, output: Path, namespace: str | None, as_json: bool) -> None:
    """Write what BAG recorded of ARM as a session in CSV.

    A row is a command and the mean of its settled sightings.

    \b
    Example:
      longarm bag to-csv arm.yaml session_bag -o samples.csv
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.sessions.bag import read_bag
    from longarm_comp.sessions.csv import write_csv

    session = read_bag(bag, Arm.load(arm), namespace)
    write_csv(session, output)
    if as_json:
        seen = int(session.seen.sum())
        print_json(
            {"output": str(output), "rows": len(session), "seen": seen, "hash": session.hash}
        )
    else:
        note(f"{len(session)} rows, {int(session.seen.sum())} with a marker, in {output}")
