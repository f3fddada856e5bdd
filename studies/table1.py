"""Table I over many arms: means, spread, paired differences, the paper's figures."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.stats import t as student

from longarm_comp.cli import options, outputs
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.files import write_text
from studies.commands import Figures, Show, arm_option, arms_option, split_interval, study_command
from studies.table1_bench import (
    COMPARISONS,
    PRINTED,
    SETTINGS,
    TARGETS,
    Outcome,
    RowSetting,
    command_arms,
)


def rows(
    arms: Sequence[Sequence[Outcome]], settings: Sequence[RowSetting] = SETTINGS
) -> list[dict[str, Any]]:
    """Return one dictionary per row of the table, in mm and mm^2, over the arms.

    `mean_abs_z_mm` and `variance_mm2` are of the true tip, `seen_mean_abs_z_mm` of what the camera
    reports; `sd_over_arms_mm` is the spread of the former.
    """
    table = []
    for k, setting in enumerate(settings):
        outcomes = [arm[k] for arm in arms]
        z = 1e3 * np.array([o.tip.mean_abs_z for o in outcomes])
        table.append(
            {
                "row": setting.row,
                "mean_abs_z_mm": float(z.mean()),
                "sd_over_arms_mm": float(z.std(ddof=1)) if len(z) > 1 else float("nan"),
                "variance_mm2": 1e6 * float(np.mean([o.tip.variance for o in outcomes])),
                "mean_mm": 1e3 * float(np.mean([o.tip.mean for o in outcomes])),
                "seen_mean_abs_z_mm": 1e3 * float(np.mean([o.seen.mean_abs_z for o in outcomes])),
                "fallbacks": int(sum(o.fallbacks for o in outcomes)),
                "paper_mean_abs_z_mm": setting.paper[0] if setting.paper else None,
                "paper_variance_mm2": setting.paper[1] if setting.paper else None,
                "arms_mm": z.tolist(),
            }
        )
    return table


def differences(
    table: Sequence[dict[str, Any]], pairs: Sequence[tuple[str, str]] = COMPARISONS
) -> list[dict[str, Any]]:
    """Compare mean |z| of one row with another's on the same arms, with a 95 % interval (mm)."""
    by_name = {row["row"]: np.array(row["arms_mm"]) for row in table}
    lines = []
    for one, other in pairs:
        if one not in by_name or other not in by_name:
            continue
        change = by_name[one] - by_name[other]
        half = float("nan")
        if len(change) > 1:
            error = change.std(ddof=1) / np.sqrt(len(change))
            half = float(student.ppf(0.975, len(change) - 1) * error)
        mean = float(change.mean())
        lines.append(
            {
                "row": one,
                "minus": other,
                "mean_mm": mean,
                "ci95_mm": [mean - half, mean + half],
                "better_arms": int((change < 0).sum()),
                "arms": len(change),
            }
        )
    return lines


def contradictions(table: Sequence[dict[str, Any]]) -> list[str]:
    """Return pairs of the paper's rows with the opposite order here, in words."""
    printed = [row for row in table if row["paper_mean_abs_z_mm"] is not None]
    found = []
    for k, one in enumerate(printed):
        for other in printed[k + 1 :]:
            ours = one["mean_abs_z_mm"] - other["mean_abs_z_mm"]
            theirs = one["paper_mean_abs_z_mm"] - other["paper_mean_abs_z_mm"]
            if ours * theirs < 0:
                better, worse = (one, other) if theirs < 0 else (other, one)
                found.append(
                    f"the paper has '{better['row']}' below '{worse['row']}' by "
                    f"{abs(theirs):.2f} mm, here it is above by {abs(ours):.2f} mm"
                )
    return found


@study_command(
    arm_option,
    arms_option(20, "Simulated arms."),
    click.option(
        "--jobs", type=int, default=-1, show_default=True, help="Processes; -1 is one per core."
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
    arm: Arm, arms: int, jobs: int, as_paper: bool, seed: int, output: Path | None, show: Show
) -> Figures:
    """Repeat the paper's Table I on simulated arms that execute the commands.

    Each arm takes one to two minutes of one core. Errors are true tip minus target; "seen" uses the
    tip that the two cameras report.

    \b
    Examples:
      longarm study table1 --arms 20 -o build/table1
      longarm study table1 --arms 2 --seed 7 --json
    """
    began = time.monotonic()
    outcomes = []
    settings = PRINTED if as_paper else SETTINGS
    for finished in command_arms(arm, arms, seed, jobs=jobs, settings=settings, as_paper=as_paper):
        outcomes.append(finished)
        show(f"{len(outcomes)} of {arms} arms", len(outcomes) / arms)
    table = rows(outcomes, settings)
    paired, contradicted = differences(table), contradictions(table)
    facts = {
        "arms": arms,
        "seed": seed,
        "targets_per_arm": TARGETS,
        "rows": table,
        "differences": paired,
        "contradicts_paper": contradicted,
        "wall_s": time.monotonic() - began,
    }
    title = f"{arms} simulated arms, {TARGETS} targets each"
    if output is not None:
        from studies.table1_figure import draw_table1

        output.mkdir(parents=True, exist_ok=True)
        write_text(output / "table1.json", json.dumps(facts, indent=2))
        draw_table1(table, output / "table1.png", title)
    better = [
        split_interval({k: line[k] for k in ("row", "minus", "mean_mm", "ci95_mm")})
        | {"better on": f"{line['better_arms']} of {line['arms']}"}
        for line in paired
    ]
    return Figures(
        facts,
        {
            f"Table I: {arms} arms, {TARGETS} targets each": [
                {k: v for k, v in row.items() if k != "arms_mm"} for row in table
            ],
            "Differences of mean |z| on the same arms": better,
        },
        contradicted,
    )
