"""``longarm study``: the list of the studies, and what each of their commands does.

A study is a module of this folder. Its last function, `command`, computes the figures; the
decorator `study_command` makes it a click command that shows progress and prints tables or JSON.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows, progress
from longarm_comp.cli.registry import Entry
from longarm_comp.cli.run import LazyGroup

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm

STUDIES = (
    Entry("table1", "table1", "The paper's Table I on simulated arms."),
    Entry("real", "real", "Held-out errors on public data of real arms."),
    Entry("touch", "touch", "Real arms that touched sockets, places held out."),
    Entry("fleet", "fleet", "Many simulated arms of one kind: what is found, what it takes."),
    Entry("realisable", "realisable", "Choice among the servos' steps, compared with rounding."),
    Entry("measurements", "measurements", "Rows needed by pose, position, distance, touch."),
    Entry("poses", "poses", "Which poses to measure: grid, Sobol, I-optimal."),
    Entry("coverage", "coverage", "How often a stated 90 % radius holds."),
    Entry("load", "load", "How well servo loads tell a payload, by servo."),
    Entry("day", "day", "A day of work: wear, warmth, changing payloads."),
    Entry("path", "path", "Planned paths, before and after compensation."),
    Entry("readings", "readings", "What joint readings bring: names, tip, trim."),
    Entry("ringing", "ringing", "How long the tip rings, and what shaping saves."),
    Entry("discover", "discover", "Causes in no library: what finds them."),
    Entry("loop", "loop", "Benchmark the diagnosis on simulated arms."),
)
"""Name, module in this folder, one line of help."""

command = LazyGroup(
    STUDIES,
    "study",
    "Studies that print the figures of docs/studies.md, from a checkout of the project.",
    folder="studies",
)

Show = Callable[[str, float], None]
"""Called with the work at hand and the share done, 0 to 1."""


@dataclass(frozen=True)
class Figures:
    """The figures of a study.

    Attributes:
        record: printed by ``--json``.
        tables: rows by title; notes: lines after them. Printed without ``--json``.
    """

    record: Mapping[str, Any]
    tables: Mapping[str, Sequence[Mapping[str, Any]]]
    notes: Sequence[str] = ()


def study_command(*given: Callable[..., Any]) -> Callable[[Callable[..., Figures]], click.Command]:
    """Make a command, with the given options and ``--json``, of a function that computes figures.

    The function gets `show` (see `Show`) besides the values of the options.
    """

    def make(compute: Callable[..., Figures]) -> click.Command:
        @functools.wraps(compute)
        def run(**words: Any) -> None:
            with progress("study " + compute.__module__.rpartition(".")[2]) as show:
                found = compute(show=show, **words)
            print_json(found.record)
            for title, rows in found.tables.items():
                print_rows(title, rows)
            for line in found.notes:
                note(line)

        return click.command()(options.several(*given, options.as_json)(run))

    return make


def _load_arm(_: click.Context, __: click.Parameter, file: Path | None) -> Arm:
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder

    return Arm.load(file or folder("config") / "arm_demo.yaml")


arm_option = click.option(
    "--arm",
    type=click.Path(path_type=Path),  # type: ignore[type-var]
    callback=_load_arm,
    help="arm.yaml of the declared arm; the demonstration's if absent.",
)
"""Option ``--arm``; the command gets the arm itself."""


def whole_number(name: str, default: int, what: str, least: int = 1) -> Callable[..., Any]:
    """Return an option for a whole number, at least ``least``."""
    return click.option(
        name, type=click.IntRange(min=least), default=default, show_default=True, help=what
    )


def arms_option(
    default: int, what: str = "Simulated arms, with other hidden errors each."
) -> Callable[..., Any]:
    """Return the option ``--arms``, a number of arms."""
    return whole_number("--arms", default, what)


def each_arm(arms: int, show: Show) -> Iterator[int]:
    """Count the arms from 0, and show how many are done."""
    for number in range(arms):
        yield number
        show(f"{number + 1} of {arms} arms", (number + 1) / arms)


def split_interval(row: Mapping[str, Any]) -> dict[str, Any]:
    """Put the ends of a row's ``ci95_mm`` into columns of their own."""
    low, high = row["ci95_mm"]
    return {k: v for k, v in row.items() if k != "ci95_mm"} | {"ci95 low": low, "high": high}
