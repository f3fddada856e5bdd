"""Output of commands: results on stdout (tables, or JSON alone), progress and notes on stderr.

A command calls both kinds of functions, those that print JSON and those that print for people. With
``--json`` only the former print, else only the latter.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import click
import numpy as np

from longarm_comp.cli.outputs import json_text

_QUIET_S = 10.0
"""Least time (s) between two lines of progress: they show that a job goes on, not each step."""

JSON, _BAR = "longarm.json", "longarm.bar"
"""Keys of a click context: whether ``--json`` was given; the progress bar on the terminal."""


def _meta() -> dict[str, Any]:
    """Return what the present command keeps in its context; empty outside a command."""
    context = click.get_current_context(silent=True)
    return {} if context is None else context.meta


def note(text: str) -> None:
    """Print a note on stderr."""
    click.echo(f"longarm: {text}", err=True)


@contextmanager
def kept_if_broken_off(kept: Callable[[], str]) -> Iterator[None]:
    """Print what an interrupted job leaves, and the next command, if the block raises."""
    try:
        yield
    except BaseException:
        if said := kept():
            note(said)
        raise


def print_json(data: object) -> None:
    """Print results as JSON; without ``--json``, print nothing."""
    if _meta().get(JSON):
        click.echo(json_text(data))


def say(text: str) -> None:
    """Print a line of the results; with ``--json``, print nothing."""
    if not _meta().get(JSON):
        click.echo(text)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print results as a table; with ``--json``, print nothing."""
    if _meta().get(JSON):
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for k, name in enumerate(header):
        table.add_column(name, justify="left" if k == 0 else "right")
    for row in rows:
        table.add_row(*(escape(_format_cell(value)) for value in row))
    # A file or a pipe has no width: nothing is cut
    Console(width=None if sys.stdout.isatty() else 1000).print(table)


def print_effects(title: str, called: Mapping[str, str], rows: Sequence[tuple[Any, ...]]) -> None:
    """Print a table of parameters, in units that people read, with the names of places (`called`).

    A row is effect, place, parameter, value, 95 % interval (None at a bound), unit.
    """
    from longarm_comp.core.effects.units import for_people

    if not rows:
        return
    cells = []
    for effect, where, name, value, ci95, unit in rows:
        times, shown = for_people(unit)
        span = "at its bound" if ci95 is None else " .. ".join(f"{times * v:.4g}" for v in ci95)
        place = called.get(where, where)
        cells.append((effect, place, name, f"{times * value:.4g}", span, shown))
    print_table(title, ("effect", "where", "parameter", "value", "95 % interval", "unit"), cells)


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows with equal keys as a table; print nothing if there are no rows."""
    if rows:
        print_table(title, list(rows[0]), [[row[name] for name in rows[0]] for row in rows])


@contextmanager
def progress(label: str, lines: bool = False) -> Iterator[Callable[..., None]]:
    """Yield a function to call with a text and, if known, the share done; it shows progress.

    On a terminal it shows a progress bar on stderr. Elsewhere it prints nothing, or, with
    ``lines``, a line every `_QUIET_S` seconds at most.
    """
    if not sys.stderr.isatty():
        said = -math.inf

        def tell(text: str, share: float | None = None) -> None:
            nonlocal said
            if lines and time.monotonic() - said >= _QUIET_S:
                said = time.monotonic()
                note(f"{label}: {text}")

        yield tell
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    meta = _meta()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task, meta[_BAR] = bar.add_task(label, total=1.0), bar

        def update(text: str, share: float | None = None) -> None:
            total = None if share is None else 1.0  # unknown: the bar runs to and fro
            described = f"{label}: {text}" if text else label
            bar.update(task, description=described, total=total, completed=share)

        try:
            yield update
        finally:
            del meta[_BAR]


@contextmanager
def progress_hidden() -> Iterator[None]:
    """Take the progress bar off the terminal in the block: it hides a question and its answer."""
    bar = _meta().get(_BAR)
    if bar is None:
        yield
        return
    bar.stop()
    try:
        yield
    finally:
        bar.start()


def _format_cell(value: object) -> str:
    if isinstance(value, (float, np.floating)):
        return "" if math.isnan(value) else f"{value:.3f}"
    if isinstance(value, (list, tuple)):
        return " .. ".join(_format_cell(part) for part in value)
    return "" if value is None else str(value)
