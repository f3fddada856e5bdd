"""``longarm touch``."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import kept_if_broken_off, note, print_json
from longarm_comp.cli.signals import handled, on_graph
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.jobs.touch import TouchLog

_HELP = "Enter: record a touch; NAME: next point; plane NAME: next plane; undo; end"


@click.command()
@options.arm
@options.output(
    "touches.csv", "Session to write; it is written after every touch.", outputs.left_to_the_command
)
@click.option("--name", default="a", help="Name of the first point.")
@click.option(
    "--distance",
    "distances",
    type=(str, str, click.FloatRange(min=0, min_open=True)),
    multiple=True,
    metavar="A B M",
    help="Known distance of two points, m; repeat for more.",
)
@click.option(
    "--tolerance-mm",
    type=click.FloatRange(min=0, min_open=True),
    default=0.1,
    help="Standard deviation of these distances.",
)
@options.flag(
    "--by-hand",
    "Switch the torque off meanwhile: hold the arm before you start, and at the end.",
)
@options.flag("--resume", "Add to an existing session.")
@options.namespace
@options.as_json
def command(
    arm: options.Arm,
    output: Path,
    name: str,
    distances: tuple[tuple[str, str, float], ...],
    tolerance_mm: float,
    by_hand: bool,
    resume: bool,
    namespace: str,
) -> None:
    """Record the joints of ARM's running graph while its tip touches points; one key a touch.

    Guide the arm by hand, or jog it, until the ball sits in the socket, and press Enter. The
    command sends nothing to the arm, except that --by-hand switches the torque off, and on again at
    the end. After some touches it prints how far each touch is from its point. If `contact` is
    published on the graph (by a wire to ball and socket, or by the simulated arm's `sockets`), a
    touch outside the socket is refused.

    \b
    Examples:
      longarm touch arm.yaml -o touches.csv --distance left_0 left_1 0.050 --name left_0
      longarm touch arm.yaml -o touches.csv --resume --by-hand
    """
    from longarm_comp.jobs.touch import TouchLog, limp
    from longarm_comp.sessions.read import read_session

    touches = TouchLog(arm, tuple((*known, 1e-3 * tolerance_mm) for known in distances))
    if output.exists() and not resume:
        raise InputError(str(output), "session", "exists", "a new file, or --resume")
    if output.exists():
        touches.begin_with(read_session(output, arm))

    written = len(touches.rows)

    def kept() -> str:
        return f"{output} keeps {written} touches; --resume adds to them" if written else ""

    with (
        kept_if_broken_off(kept),
        on_graph("touch", namespace, arm) as client,
        limp(client) if by_hand else nullcontext(""),
    ):
        note(_HELP)
        column, line = "touch", _asked(f"touch {name}", client.stop)
        while line != "end":
            if not line:
                try:
                    touches.take(client, name, column)
                except JobError as error:
                    if client.stop.is_set():
                        raise
                    note(str(error))
            elif line == "undo":
                del touches.rows[-1:]
            elif line.startswith("plane "):
                column, name = "plane", line.removeprefix("plane ")
            else:
                column, name = "touch", line
            if line in ("", "undo"):
                _kept(touches, output)
                written = len(touches.rows)
            line = _asked(f"{column} {name}", client.stop)
    print_json({"output": output, "rows": written})
    file = click.get_current_context().params["arm"]
    done = f"{written} touches in {output}; next: longarm calibrate {file} {output}"
    note(done if written else "no touch was recorded, nothing is written")


def _asked(prompt: str, stop: Event) -> str:
    """The next line; the end of the input ends the session, and a signal waits for no key."""

    def now(*_: object) -> None:
        stop.set()
        raise KeyboardInterrupt

    try:
        with handled(now):
            return str(click.prompt(prompt, default="", show_default=False, err=True)).strip()
    except click.Abort:
        if stop.is_set():
            raise
        return "end"


def _kept(touches: TouchLog, output: Path) -> None:
    from longarm_comp.sessions.csv import write_csv

    if not touches.rows:
        output.unlink(missing_ok=True)
        return
    write_csv(touches.session(), output)
    spread = touches.spread_m()
    said = f"{len(touches.rows)} rows"
    if spread is not None:
        said += f"; {1e3 * spread.mean():.2f} mm from their points in the mean"
        if touches.rows[-1][1] == "touch":
            said += f", the last one {1e3 * spread[-1]:.2f} mm"
    note(said)
