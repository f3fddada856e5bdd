"""``longarm sim unplug``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@click.argument("name", metavar="JOINT")
@click.option("--back", is_flag=True, help="Put it right again.")
@options.namespace
def command(name: str, back: bool, namespace: str) -> None:
    """Rehearse a fault of a simulated arm: the servo of JOINT does not answer.

    \b
    Examples:
      longarm sim unplug joint2
      longarm sim unplug joint2 --back
    """
    from longarm_comp.cli.output import note
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.client import GraphClient
    from longarm_comp.jobs.rehearse import spoil

    with stop_on_signals() as stop, GraphClient(namespace, stop, "rehearse") as client:
        said = spoil(client, "unplugged", name, back)
    note(f"{said}; longarm status says what the arm makes of it")
