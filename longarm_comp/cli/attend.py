"""``longarm status``, ``hold``, ``stop`` and ``reset``: what a person asks of a running arm."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json

if TYPE_CHECKING:
    from longarm_comp.jobs.attend import Attendant


@contextmanager
def _attendant(namespace: str, name: str) -> Iterator[Attendant]:
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.attend import Attendant
    from longarm_comp.jobs.client import GraphClient

    with stop_on_signals() as stop, GraphClient(namespace, stop, name) as client:
        yield Attendant(client)


@click.command()
@options.namespace
@options.as_json
def status(namespace: str, as_json: bool) -> None:
    """Say how the running arm stands: its driver, every trouble with its cause, the next command.

    \b
    Example:
      longarm status
    """
    from dataclasses import asdict

    with _attendant(namespace, "status") as attendant:
        found = attendant.standing()
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
    if found.learned:
        click.echo(f"At work: {found.learned}.")
    if found.next:
        click.echo(f"Next: {found.next}")


@click.command()
@options.namespace
def hold(namespace: str) -> None:
    """Stop the running arm smoothly and keep it where it is, torque on; `longarm reset` goes on.

    Trajectories are refused meanwhile.

    \b
    Example:
      longarm hold
    """
    with _attendant(namespace, "hold") as attendant:
        note(attendant.hold())


@click.command()
@options.namespace
def stop(namespace: str) -> None:
    """Cut the torque of the running arm now: an arm without brakes drops. No safety function.

    `longarm reset` switches it on again. To keep a heavy arm up: `longarm hold`.

    \b
    Example:
      longarm stop
    """
    with _attendant(namespace, "stop") as attendant:
        note(attendant.stop())


@click.command()
@options.namespace
def reset(namespace: str) -> None:
    """Go on after a hold, a stop, or a fault whose cause is gone. The arm stays where it is.

    \b
    Example:
      longarm reset
    """
    with _attendant(namespace, "reset") as attendant:
        note(attendant.reset())
