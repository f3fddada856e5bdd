"""``longarm view``."""

from __future__ import annotations

from collections.abc import Callable

import click

from longarm_comp.cli import options
from longarm_comp.core.errors import JobError


@click.command()
@options.namespace
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8080,
    help="Port of the page; if it is taken, the next free port. 0: any free port.",
)
@click.option("--open/--no-open", "show", default=True, help="Open the page in the browser.")
def command(namespace: str, port: int, show: bool) -> None:
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
        import viser  # noqa: F401
    except ModuleNotFoundError as error:
        wanted = "pip install 'longarm_comp[view]'"
        raise JobError(f"longarm view needs {error.name}: {wanted}") from error
    from longarm_comp.view.run import view

    def opened(link: Callable[[], str]) -> None:
        click.echo(link())
        if show:
            click.launch(link())

    with stop_on_signals() as stop:
        view(namespace, port, stop, opened)
