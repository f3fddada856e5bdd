"""``longarm reset``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@options.namespace
def command(namespace: str) -> None:
    """Go on after a hold, a stop, or a fault whose cause is gone. The arm stays where it is.

    \b
    Example:
      longarm reset
    """
    from longarm_comp.cli.output import note
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.attend import Attendant
    from longarm_comp.jobs.client import GraphClient

    with stop_on_signals() as stop, GraphClient(namespace, stop, "reset") as client:
        note(Attendant(client).reset())
