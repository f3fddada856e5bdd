"""``longarm status``."""

from __future__ import annotations

import click

from longarm_comp.cli import options


@click.command()
@options.namespace
@options.as_json
def command(namespace: str, as_json: bool) -> None:
    """Say how the running arm stands: its driver, every trouble with its cause, the next command.

    \b
    Example:
      longarm status
    """
    from dataclasses import asdict

    from longarm_comp.cli.output import print_json
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.attend import Attendant
    from longarm_comp.jobs.client import GraphClient

    with stop_on_signals() as stop, GraphClient(namespace, stop, "status") as client:
        found = Attendant(client).standing()
    if as_json:
        print_json(asdict(found))
        return
    why = f": {found.why}" if found.why else ""
    click.echo(f"The driver is {found.driver}{why}." if found.driver else f"{found.why}.")
    for trouble in found.troubles:
        click.echo(f"{trouble.level}: {trouble.node}, {trouble.part}: {trouble.message}")
    if not found.troubles:
        click.echo(f"All is well: {', '.join(found.nodes)}.")
    if found.tip:
        click.echo(f"{found.tip[0].upper()}{found.tip[1:]}.")
    if found.next:
        click.echo(f"Next: {found.next}")
