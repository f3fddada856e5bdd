"""``longarm study path``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from longarm_comp.cli import options, outputs
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    shape.arm,
    shape.arms(8, "Simulated arms; every other one has play."),
    shape.number("--paths", 2, "Paths of every kind and speed, an arm."),
    options.seed,
    options.written_option(
        "-o/--output",
        "JSON-lines file, one line an arm. Arms in it are not run again.",
        outputs.with_marks(b"{"),
    ),
)
def command(
    arm: Arm, arms: int, paths: int, seed: int, output: Path | None, show: shape.Show
) -> shape.Figures:
    """How far the true tip leaves a planned path, before and after compensation.

    Lines, arcs and straight plans of joints, at three speeds of the tip. After an interruption the
    same command continues its file.

    \b
    Example:
      longarm study path --arms 8 -o build/path.jsonl
    """
    from studies import path

    rows = path.table(list(path.study(arm, arms, seed, paths, output, show)))
    title = f"Deviation of the true tip from planned paths, {arms} arms"
    return shape.Figures({"rows": rows}, {title: rows})
