"""``longarm sim cover``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@click.argument("name", metavar="CAMERA")
@click.option("--back", is_flag=True, help="Put it right again.")
@options.namespace
def command(name: str, back: bool, namespace: str) -> None:
    """Rehearse a fault of a simulated arm: the camera CAMERA (left or right) sees nothing.

    \b
    Examples:
      longarm sim cover left
      longarm sim cover left --back
    """
    from longarm_comp.cli.output import note
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.client import GraphClient
    from longarm_comp.jobs.rehearse import spoil

    with stop_on_signals() as stop, GraphClient(namespace, stop, "rehearse") as client:
        said = spoil(client, "covered", name, back)
    note(f"{said}; longarm status says what the arm makes of it")
