"""Questions to the user, signals, and a client on the running graph.

Every question can also be answered by a flag. It is asked only if the flag is missing. A question
that nobody answers is an error.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli.output import progress_hidden
from longarm_comp.core.errors import InputError, JobError

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@contextmanager
def handle_signals(
    handler: Callable[..., Any], numbers: Sequence[int] = (signal.SIGINT, signal.SIGTERM)
) -> Iterator[None]:
    """Handle signals by a function within the block, and restore the earlier handlers after it.

    `signal.default_int_handler` raises KeyboardInterrupt, so that ``finally`` clauses run.
    """
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set."""
    stop = threading.Event()
    with handle_signals(lambda *_: stop.set()):
        yield stop


@contextmanager
def on_graph(name: str, namespace: str, arm: Arm | None = None, **how: Any) -> Iterator[Any]:
    """Yield an `ArmClient` (without an arm a `GraphClient`), whose waits SIGINT and SIGTERM stop.

    Args:
        name: name of the client's node.
        how: further arguments of the client.
    """
    from longarm_comp.jobs.client import ArmClient
    from longarm_comp.jobs.graph_client import GraphClient

    of: Callable[..., GraphClient] = GraphClient if arm is None else partial(ArmClient, arm)
    with stop_on_signals() as stop, of(namespace, stop, name, **how) as client:
        yield client


def user_agrees(question: str, yes: bool) -> bool:
    """Ask a yes-or-no question, unless ``--yes`` was given. Raises JobError without an answer."""
    if yes:
        return True
    try:
        with handle_signals(signal.default_int_handler, [signal.SIGINT]), progress_hidden():
            return click.confirm(question, err=True)
    except click.Abort:
        raise JobError("there was no answer yes: answer the question, or use --yes") from None


def ask(command: str, flag: str, text: str, allowed: str, **options: Any) -> Any:
    """Return the user's answer to the question `text`, which the flag answers too.

    Args:
        allowed: allowed answers, for the error message.
        options: further options of `click.prompt`.

    Raises:
        InputError: the input ended without an answer, and it is no terminal.
    """
    try:
        return click.prompt(text, err=True, **options)
    except click.Abort as abort:
        click.echo(err=True)  # the cursor stands behind the question
        if sys.stdin.isatty() or isinstance(abort.__context__, KeyboardInterrupt):
            raise
        allowed = f"{allowed}; or a terminal that can ask you"
        raise InputError(command, flag, "missing", allowed) from None


def go_on(command: str, yes: bool, text: str) -> None:
    """Ask whether to go on, unless `yes`. Raises click.Abort if the user says no."""
    if not yes and not ask(command, "--yes", f"{text} Go on?", "--yes", default="y", type=bool):
        raise click.Abort


def by_name(
    command: str, flag: str, given: Sequence[str], form: str, names: Sequence[str] | None = None
) -> dict[str, str]:
    """Read the values of a repeated flag ``NAME=VALUE``; InputError states the expected `form`.

    Each name may be given once, and must be one of `names`, if these are given.
    """
    values: dict[str, str] = {}
    for text in given:
        name, _, value = map(str.strip, text.partition("="))
        if not name or not value or name in values or (names is not None and name not in names):
            known = "" if names is None else f", names {', '.join(names)}"
            raise InputError(command, flag, text, f"{form}, each once{known}")
        values[name] = value
    return values


def numbers_by_name(
    command: str, flag: str, given: Sequence[str], form: str, names: Sequence[str] | None = None
) -> dict[str, float]:
    """Return the values of a repeated flag ``NAME=VALUE`` as numbers, read as `by_name` does.

    Raises:
        InputError: a value is no number, or its size is a million or more.
    """
    values = {}
    for name, text in by_name(command, flag, given, form, names).items():
        try:
            values[name] = float(text)
        except ValueError:
            values[name] = math.nan
        if not abs(values[name]) < 1e6:
            raise InputError(command, flag, f"{name}={text}", form)
    return values
