"""``longarm hold``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@options.namespace
def command(namespace: str) -> None:
    """Stop the running arm smoothly and keep it where it is, torque on; `longarm reset` goes on.

    Trajectories are refused meanwhile.

    \b
    Example:
      longarm hold
    """
    from longarm_comp.cli.output import note
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.attend import Attendant
    from longarm_comp.jobs.client import GraphClient

    with stop_on_signals() as stop, GraphClient(namespace, stop, "hold") as client:
        note(Attendant(client).hold())
