"""``longarm study path``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import print_json, print_rows, progress


@click.command()
@options.path_option("--arm", "Declared arm; the demonstration's if absent.")
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=8, show_default=True,
    help="Simulated arms; every other one has play.",
)  # fmt: skip
@click.option(
    "--paths", type=click.IntRange(min=1), default=2, show_default=True,
    help="Paths of every kind and speed, an arm.",
)  # fmt: skip
@options.seed
@options.as_json
@options.written(
    "-o/--output",
    "JSON-lines file, one line an arm. Arms in it are not run again.",
    outputs.marked(b"{"),
)
def command(
    arm: Path | None, count: int, paths: int, seed: int, as_json: bool, output: Path | None
) -> None:
    """How far the true tip leaves a planned path, before and after compensation.

    Lines, arcs and straight plans of joints, at three speeds of the tip. After an interruption the
    same command continues its file.

    \b
    Example:
      longarm study path --arms 8 -o build/path.jsonl
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.share import folder
    from studies import path

    declared = Arm.load(arm or folder("config") / "arm_demo.yaml")
    with progress("study path") as show:
        rows = path.table(list(path.study(declared, count, seed, paths, output, show)))
    if as_json:
        print_json({"rows": rows})
        return
    print_rows(f"Deviation of the true tip from planned paths, {count} arms", rows)
