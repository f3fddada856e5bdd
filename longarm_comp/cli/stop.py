"""``longarm stop``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@options.namespace
def command(namespace: str) -> None:
    """Cut the torque of the running arm now: an arm without brakes drops. No safety function.

    `longarm reset` switches it on again. To keep a heavy arm up: `longarm hold`.

    \b
    Example:
      longarm stop
    """
    from longarm_comp.cli.output import note
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.attend import Attendant
    from longarm_comp.jobs.client import GraphClient

    with stop_on_signals() as stop, GraphClient(namespace, stop, "stop") as client:
        note(Attendant(client).stop())
