"""``longarm study loop``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options, outputs
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    options.output(
        None,
        "JSON-lines file, one line per case. Cases in it are not run again.",
        outputs.with_marks(b"{"),
    ),
    shape.arm,
    click.option("--groups", default="none,single,pair,removed,outside", show_default=True),
    click.option("--effects", help="Canonical names, separated by commas; all by default."),
    click.option("--plans", default="grid", show_default=True, help="grid, sobol, or both."),
    click.option(
        "--rows", default="300,60", show_default=True, help="Sample sizes, separated by commas."
    ),
    click.option(
        "--noises", default="1", show_default=True, help="Factors on the usual camera noise."
    ),
    shape.arms(3, "Arms like the declared one."),
    shape.number("--repeats", 2, "Repetitions per arm."),
    shape.number("--pairs", 20, "Pairs per arm and size.", least=0),
    click.option(
        "--jobs", type=int, default=-1, show_default=True, help="Processes; -1: all cores."
    ),
    options.dask,
)
def command(
    output: Path, arm: Arm, groups: str, effects: str | None, plans: str, rows: str, noises: str,
    arms: int, repeats: int, pairs: int, jobs: int, dask: str | None, show: shape.Show,
) -> shape.Figures:  # fmt: skip
    """Benchmark the diagnosis on simulated arms with hidden effects.

    Cases run on all cores, or on a Dask cluster. After an interruption the same command continues.
    It ends with a table of shares with 95 % Wilson intervals.

    \b
    Examples:
      longarm study loop -o loop.jsonl
      longarm study loop -o loop.jsonl --groups none --rows 300 --repeats 12
      longarm study loop -o loop.jsonl --dask tcp://head:8786
    """
    from studies.loop import run
    from studies.loop_cases import NAMES, Design
    from studies.loop_table import by_effect, failures, reliability, summary

    design = Design(
        groups=groups.split(","),
        effects=NAMES if effects is None else effects.split(","),
        plans=plans.split(","),
        rows=_numbers("--rows", rows, int),
        noises=_numbers("--noises", noises, float),
        arms=arms,
        repeats=repeats,
        pairs=pairs,
    )
    lines = run(design.cases(), arm, output, jobs=jobs, dask=dask, progress=show)
    tables = {
        "summary": (f"{len(lines)} cases", summary(lines)),
        "by_effect": ("Visible single effects", by_effect(lines)),
        "reliability": ("Names by their stated probability", reliability(lines)),
    }
    broken = failures(lines)
    return shape.Figures(
        {name: rows for name, (_, rows) in tables.items()} | {"failures": broken},
        dict(tables.values()),
        broken,
    )


def _numbers(name: str, text: str, kind: type) -> list:
    from longarm_comp.core.errors import InputError

    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise InputError("study loop", name, text, "numbers with commas between") from None
