"""``longarm study table1``."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options, outputs
from studies.commands import shape

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm


@shape.study(
    shape.arm,
    shape.arms(20, "Simulated arms."),
    click.option(
        "--jobs", type=int, default=-1, show_default=True, help="Processes; -1 is one per core."
    ),
    click.option(
        "--poses",
        is_flag=True,
        help="Command whole poses and print the angle that is left; rows of up to 300 samples.",
    ),
    click.option(
        *("--paper-setting", "as_paper"),
        is_flag=True,
        help="The paper's rows alone; every joint arrives from below, 300 samples are the last of "
        "the grid in its order.",
    ),
    options.seed,
    options.written_option(
        "-o/--output",
        "Folder for table1.json and table1.png.",
        outputs.folder("table1.json", "table1.png", told_by="table1.json"),
    ),
)
def command(
    arm: Arm, arms: int, jobs: int, poses: bool, as_paper: bool, seed: int, output: Path | None,
    show: shape.Show,
) -> shape.Figures:  # fmt: skip
    """Repeat the paper's Table I on simulated arms that execute the commands.

    Each arm takes one to two minutes of one core. Errors are true tip minus target; "seen" uses the
    tip that the two cameras report.

    \b
    Examples:
      longarm study table1 --arms 20 -o build/table1
      longarm study table1 --arms 2 --seed 7 --json
    """
    from longarm_comp.core.files import write_text
    from studies import table1_summary as summary
    from studies.table1 import PRINTED, SAMPLES, SETTINGS, study

    began = time.monotonic()
    outcomes = []
    settings = PRINTED if as_paper else SETTINGS
    if poses:
        settings = tuple(s for s in settings if s.samples <= min(SAMPLES))
    for finished in study(
        arm, arms, seed, jobs=jobs, settings=settings, whole_poses=poses, as_paper=as_paper
    ):
        outcomes.append(finished)
        show(f"{len(outcomes)} of {arms} arms", len(outcomes) / arms)
    table = summary.rows(outcomes, settings)
    differences, contradictions = summary.differences(table), summary.contradictions(table)
    facts = {
        "arms": arms,
        "seed": seed,
        "targets_per_arm": summary.TARGETS,
        "rows": table,
        "differences": differences,
        "contradicts_paper": contradictions,
        "wall_s": time.monotonic() - began,
    }
    if output is not None:
        from studies.table1_figure import Table1Row, table1_figure

        output.mkdir(parents=True, exist_ok=True)
        write_text(output / "table1.json", json.dumps(facts, indent=2))
        table1_figure(
            [
                Table1Row(
                    row=row["row"],
                    mean_abs_z_mm=row["arms_mm"],
                    paper_mm=row["paper_mean_abs_z_mm"],
                )
                for row in table
            ],
            output / "table1.png",
            title=f"{arms} simulated arms, {summary.TARGETS} targets each",
        )
    hidden = {"arms_mm"} if poses else {"arms_mm", "orientation_mrad"}
    shown = [{k: v for k, v in row.items() if k not in hidden} for row in table]
    better = [
        shape.with_ends({k: line[k] for k in ("row", "minus", "mean_mm", "ci95_mm")})
        | {"better on": f"{line['better_arms']} of {line['arms']}"}
        for line in differences
    ]
    return shape.Figures(
        facts,
        {
            f"Table I: {arms} arms, {summary.TARGETS} targets each": shown,
            "Differences of mean |z| on the same arms": better,
        },
        contradictions,
    )
