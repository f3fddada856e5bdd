"""What the command of every study does: load the arm, show progress, print tables or JSON."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, progress

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm

Show = Callable[[str, float], None]
"""Told what is being done and the share done, 0 to 1."""


@dataclass(frozen=True)
class Figures:
    """What a study found.

    Attributes:
        record: what ``--json`` prints.
        tables: rows by title; notes: lines after them. Printed without ``--json``.
    """

    record: Mapping[str, Any]
    tables: Mapping[str, Sequence[Mapping[str, Any]]]
    notes: Sequence[str] = ()


def study(*given: Callable[..., Any]) -> Callable[[Callable[..., Figures]], click.Command]:
    """A command with the given options and ``--json``, from what computes its figures.

    That gets `show` besides what the options bring.
    """

    def command(compute: Callable[..., Figures]) -> click.Command:
        label = "study " + compute.__module__.rpartition(".")[2].replace("_", "-")

        @functools.wraps(compute)
        def run(**words: Any) -> None:
            with progress(label) as show:
                found = compute(show=show, **words)
            print_json(found.record)
            for title, rows in found.tables.items():
                print_rows(title, rows)
            for line in found.notes:
                note(line)

        made = run
        for option in reversed((*given, options.as_json)):
            made = option(made)
        return click.command()(made)

    return command


def _declared(_: click.Context, __: click.Parameter, file: Path | None) -> Arm:
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder

    return Arm.load(file or folder("config") / "arm_demo.yaml")


arm = click.option(
    "--arm",
    type=click.Path(path_type=Path),  # type: ignore[type-var]
    callback=_declared,
    help="arm.yaml of the declared arm; the demonstration's if absent.",
)
"""Option ``--arm``; the command gets the arm itself."""


def number(name: str, default: int, what: str, least: int = 1) -> Callable[..., Any]:
    """A whole number, at least ``least``."""
    return click.option(
        name, type=click.IntRange(min=least), default=default, show_default=True, help=what
    )


def arms(default: int, what: str = "Simulated arms, with other hidden errors each.") -> Any:
    """Option ``--arms``: how many."""
    return number("--arms", default, what)


def with_ends(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with the ends of ``ci95_mm`` in columns of their own."""
    low, high = row["ci95_mm"]
    return {k: v for k, v in row.items() if k != "ci95_mm"} | {"ci95 low": low, "high": high}
