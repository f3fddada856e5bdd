"""``longarm sim unplug``, ``cover`` and ``freeze``: faults of a simulated arm, to rehearse."""

from __future__ import annotations

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note

_back = click.option("--back", is_flag=True, help="Put it right again.")


def _spoil(fault: str, name: str, back: bool, namespace: str) -> None:
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.client import GraphClient
    from longarm_comp.jobs.rehearse import spoil

    with stop_on_signals() as stop, GraphClient(namespace, stop, "rehearse") as client:
        said = spoil(client, fault, name, back)
    note(f"{said}; longarm status says what the arm makes of it")


@click.command()
@click.argument("name", metavar="JOINT")
@_back
@options.namespace
def unplug(name: str, back: bool, namespace: str) -> None:
    """Rehearse a fault of a simulated arm: the servo of JOINT does not answer.

    \b
    Examples:
      longarm sim unplug joint2
      longarm sim unplug joint2 --back
    """
    _spoil("unplugged", name, back, namespace)


@click.command()
@click.argument("name", metavar="CAMERA")
@_back
@options.namespace
def cover(name: str, back: bool, namespace: str) -> None:
    """Rehearse a fault of a simulated arm: the camera CAMERA (left or right) sees nothing.

    \b
    Examples:
      longarm sim cover left
      longarm sim cover left --back
    """
    _spoil("covered", name, back, namespace)


@click.command()
@click.argument("node", metavar="NODE")
@click.option(
    "--for", "seconds", type=click.FloatRange(0.1), default=10.0, show_default=True, help="s."
)
@options.namespace
def freeze(node: str, seconds: float, namespace: str) -> None:
    """Rehearse a hang: NODE of a simulated arm stands still for a while, or until Ctrl-C.

    \b
    Example:
      longarm sim freeze kinematics --for 20
    """
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.client import GraphClient
    from longarm_comp.jobs.rehearse import frozen

    with stop_on_signals() as stop, GraphClient(namespace, stop, "rehearse") as client:
        with frozen(client, node) as process:
            note(f"{node} (process {process}) stands still for {seconds:g} s")
            stop.wait(seconds)
        note(f"{node} goes on")
