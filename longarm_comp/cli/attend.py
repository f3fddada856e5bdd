"""Commands for a running arm: its state, hold, stop, reset, view, and faults to rehearse."""

from collections.abc import Callable

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, say
from longarm_comp.cli.signals import on_graph, user_agrees
from longarm_comp.core.errors import JobError


@click.command()
@options.namespace
@options.as_json
def status(namespace: str) -> None:
    """Print the state of the running arm: its driver, every problem with its cause, the next
    command.

    \b
    Example:
      longarm status
    """
    from longarm_comp.jobs.attend import Attendant

    with on_graph("status", namespace) as client:
        found = Attendant(client).standing()
    print_json(found)
    driver, reason, tip = (found[key] for key in ("driver", "why", "tip"))
    why = f": {reason}" if reason else ""
    say(f"The driver is {driver}{why}." if driver else f"{reason}.")
    for trouble in found["troubles"]:
        say("{level}: {node}, {part}: {message}".format_map(trouble))
    if not found["troubles"]:
        say(f"All is well: {', '.join(found['nodes'])}.")
    if tip:
        say(f"{tip[0].upper()}{tip[1:]}.")
    if found["learned"]:
        say(f"At work: {found['learned']}.")
    if found["next"]:
        say(f"Next: {found['next']}")


def _asked_of_the_driver(name: str, what: str) -> click.Command:
    """Return a command that sends one request to the driver by the `Attendant`'s method `name`."""

    def ask(namespace: str) -> None:
        from longarm_comp.jobs.attend import Attendant

        with on_graph(name, namespace) as client:
            note(getattr(Attendant(client), name)())

    ask.__doc__ = f"{what}\n\n\b\nExample:\n  longarm {name}"
    return click.command(name)(options.namespace(ask))


hold = _asked_of_the_driver(
    "hold",
    "Stop the running arm smoothly and keep it where it is, torque on; `longarm reset` goes on.\n\n"
    "Trajectories are refused meanwhile. Without a driver that answers, nothing is held.",
)
stop = _asked_of_the_driver(
    "stop",
    "Cut the torque of the running arm now: an arm without brakes drops. No safety function.\n\n"
    "`longarm reset` switches it on again. To keep a heavy arm up: `longarm hold`.\n\n"
    "Without a driver that answers nothing is stopped, and the command says so.",
)


@click.command()
@options.namespace
@options.flag("--kept", "End stops that no driver is there to end; each is shown and asked.")
@options.flag("--yes", "With --kept: end all that are shown.")
def reset(namespace: str, kept: bool, yes: bool) -> None:
    """End a hold, a stop, or a fault whose cause is gone. The arm stays where it is.

    A driver that runs ends its own stops, without --kept.

    \b
    Examples:
      longarm reset
      longarm reset --kept
    """
    if kept:
        from longarm_comp.devices.state_folder import state_folder
        from longarm_comp.devices.stop_latch import kept_stops

        standing = kept_stops(state_folder())
        for stop in standing:
            note(str(stop))
            if user_agrees("End it?", yes):
                stop.file.unlink(missing_ok=True)
        note("nothing to reset" if not standing else "a driver that runs keeps its own stops")
        return
    from longarm_comp.jobs.attend import Attendant

    with on_graph("reset", namespace) as client:
        note(Attendant(client).reset())


def _make_fault(name: str, parameter: str, metavar: str, what: str, example: str) -> click.Command:
    """Return a command that adds a name to a parameter of the simulated arm, or removes it."""

    def spoil(name: str, back: bool, namespace: str) -> None:
        from longarm_comp.jobs import attend

        with on_graph("rehearse", namespace) as client:
            said = attend.spoil(client, parameter, name, back)
        note(f"{said}; `longarm status` shows how the arm reacts")

    words = f"longarm sim {name} {example}"
    spoil.__doc__ = (
        f"Rehearse a fault of a simulated arm: {what}.\n\n\b\n"
        f"Examples:\n  {words}\n  {words} --back"
    )
    back = click.option("--back", is_flag=True, help="Put it right again.")
    named = click.argument("name", metavar=metavar)
    return click.command(name)(named(back(options.namespace(spoil))))


unplug = _make_fault("unplug", "unplugged", "JOINT", "the servo of JOINT does not answer", "joint2")
_BLIND = "the camera CAMERA (left or right) sees nothing"
cover = _make_fault("cover", "covered", "CAMERA", _BLIND, "left")


@click.command()
@click.argument("node", metavar="NODE")
@click.option("--for", "seconds", type=click.FloatRange(0.1), default=10.0, help="s.")
@options.namespace
def freeze(node: str, seconds: float, namespace: str) -> None:
    """Rehearse a fault of a simulated arm: NODE hangs for a while, or until Ctrl-C.

    \b
    Example:
      longarm sim freeze kinematics --for 20
    """
    from longarm_comp.jobs.attend import freeze_node

    with on_graph("rehearse", namespace) as client:
        with freeze_node(client, node) as process:
            note(f"{node} (process {process}) stands still for {seconds:g} s")
            client.stop.wait(seconds)
        note(f"{node} goes on")


@click.command()
@options.namespace
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8080,
    help="Port of the page; if it is taken, the next free port. 0: any free port.",
)
@click.option("--open/--no-open", "show", default=True, help="Open the page in the browser.")
def view(namespace: str, port: int, show: bool) -> None:
    """Show a running graph on a page in the browser of this machine, until Ctrl-C.

    The page shows the arm as declared and as it hangs, target, tip and errors, the health
    of the nodes and the progress of `collect`. It has buttons for hold, software stop and reset.
    Only this machine can open the page, with the printed link, which works once and in one browser.

    \b
    Examples:
      longarm view
      longarm view --namespace left_arm --port 8081 --no-open
    """
    from longarm_comp.cli.signals import stop_on_signals

    try:
        from longarm_comp.view import run
    except ModuleNotFoundError as error:
        wanted = "pip install 'longarm_comp[view]'"
        raise JobError(f"longarm view needs {error.name}: {wanted}") from error

    def open_link(link: Callable[[], str]) -> None:
        click.echo(link())
        if show:
            click.launch(link())

    with stop_on_signals() as stop:
        run.view(namespace, port, stop, open_link)
