"""``longarm sim freeze``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@click.argument("node", metavar="NODE")
@click.option(
    "--for", "seconds", type=click.FloatRange(0.1), default=10.0, show_default=True, help="s."
)
@options.namespace
def command(node: str, seconds: float, namespace: str) -> None:
    """Rehearse a hang: NODE of a simulated arm stands still for a while, or until Ctrl-C.

    \b
    Example:
      longarm sim freeze kinematics --for 20
    """
    from longarm_comp.cli.output import note
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.client import GraphClient
    from longarm_comp.jobs.rehearse import frozen

    with stop_on_signals() as stop, GraphClient(namespace, stop, "rehearse") as client:
        with frozen(client, node) as process:
            note(f"{node} (process {process}) stands still for {seconds:g} s")
            stop.wait(seconds)
        note(f"{node} goes on")
