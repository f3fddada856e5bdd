"""``longarm study table1``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_rows, progress


@click.command()
@options.path_option(
    "--arm", "Declared arm whose variants are built; the demonstration's if absent."
)
@click.option(
    *("--arms", "count"), type=click.IntRange(min=1), default=20, show_default=True,
    help="Simulated arms.",
)  # fmt: skip
@click.option(
    *("--jobs",), type=int, default=-1, show_default=True, help="Processes; -1 is one per core."
)
@click.option(
    *("--poses",),
    is_flag=True,
    help="Command whole poses and print the angle that is left; rows of up to 300 samples.",
)
@click.option(
    *("--paper-setting", "as_paper"),
    is_flag=True,
    help="The paper's rows alone; every joint arrives from below, 300 samples are the last of "
    "the grid in its order.",
)
@options.seed
@options.as_json
@options.written(
    "-o/--output",
    "Folder for table1.json and table1.png.",
    outputs.folder("table1.json", "table1.png", told_by="table1.json"),
)
def command(
    arm: Path | None,
    count: int,
    jobs: int,
    poses: bool,
    as_paper: bool,
    seed: int,
    as_json: bool,
    output: Path | None,
) -> None:
    """Repeat the paper's Table I on simulated arms that execute the commands.

    Each arm takes one to two minutes of one core. Errors are true tip minus target; "seen" uses
    the tip that the stereo head reports.

    \b
    Examples:
      longarm study table1 --arms 20 -o build/table1
      longarm study table1 --arms 2 --seed 7 --json
    """
    import json
    import time
    from typing import Any

    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.files import write_text
    from longarm_comp.share import folder
    from studies import table1_summary as summary
    from studies.table1 import PRINTED, SAMPLES, SETTINGS, study

    base = Arm.load(arm or folder("config") / "arm_demo.yaml")
    began = time.monotonic()
    outcomes = []
    settings = PRINTED if as_paper else SETTINGS
    if poses:
        settings = tuple(s for s in settings if s.samples <= min(SAMPLES))
    with progress("study table1") as show:
        for finished in study(
            base, count, seed, jobs=jobs, settings=settings, whole_poses=poses, as_paper=as_paper
        ):
            outcomes.append(finished)
            show(f"{len(outcomes)} of {count} arms", len(outcomes) / count)
    table = summary.rows(outcomes, settings)
    facts: dict[str, Any] = {
        "arms": count,
        "seed": seed,
        "targets_per_arm": summary.TARGETS,
        "rows": table,
        "differences": summary.differences(table),
        "contradicts_paper": summary.contradictions(table),
        "wall_s": time.monotonic() - began,
    }
    if output is not None:
        from studies.table1_figure import table1_figure

        output.mkdir(parents=True, exist_ok=True)
        write_text(output / "table1.json", json.dumps(facts, indent=2))
        table1_figure(
            [
                {
                    "row": row["row"],
                    "mean_abs_z_mm": row["arms_mm"],
                    "paper_mm": row["paper_mean_abs_z_mm"],
                }
                for row in table
            ],
            output / "table1.png",
            title=f"{count} simulated arms, {summary.TARGETS} targets each",
        )
    if as_json:
        print_json(facts)
        return
    hidden = {"arms_mm"} if poses else {"arms_mm", "orientation_mrad"}
    shown = [{k: v for k, v in row.items() if k not in hidden} for row in table]
    print_rows(f"Table I: {count} arms, {summary.TARGETS} targets each", shown)
    print_rows(
        "Differences of mean |z| on the same arms",
        [
            {
                "row": d["row"],
                "minus": d["minus"],
                "mean_mm": d["mean_mm"],
                "ci95 low": d["ci95_mm"][0],
                "high": d["ci95_mm"][1],
                "better on": f"{d['better_arms']} of {d['arms']}",
            }
            for d in facts["differences"]
        ],
    )
    for line in facts["contradicts_paper"]:
        note(line)
