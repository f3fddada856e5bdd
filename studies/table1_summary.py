"""Summary of Table I over many arms: means, spread, paired differences, the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student

from studies.table1 import COMPARISONS, SETTINGS, TARGETS, Outcome, RowSetting

__all__ = ["TARGETS", "contradictions", "differences", "rows"]


def rows(
    arms: Sequence[Sequence[Outcome]], settings: Sequence[RowSetting] = SETTINGS
) -> list[dict[str, Any]]:
    """One dictionary per row of the table, in mm and mm^2, over the arms.

    `mean_abs_z_mm` and `variance_mm2` are of the true tip, `seen_mean_abs_z_mm` of what the camera
    reports; `sd_over_arms_mm` is the spread of the former; `orientation_mrad` is None
    where positions alone were asked for.
    """
    table = []
    for k, setting in enumerate(settings):
        outcomes = [arm[k] for arm in arms]
        turned = np.mean([o.turned for o in outcomes])
        z = 1e3 * np.array([o.tip.mean_abs_z for o in outcomes])
        table.append(
            {
                "row": setting.row,
                "mean_abs_z_mm": float(z.mean()),
                "sd_over_arms_mm": float(z.std(ddof=1)) if len(z) > 1 else float("nan"),
                "variance_mm2": 1e6 * float(np.mean([o.tip.variance for o in outcomes])),
                "mean_mm": 1e3 * float(np.mean([o.tip.mean for o in outcomes])),
                "seen_mean_abs_z_mm": 1e3 * float(np.mean([o.seen.mean_abs_z for o in outcomes])),
                "orientation_mrad": None if np.isnan(turned) else 1e3 * float(turned),
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
    """Mean |z| of one row minus that of another on the same arms, with a 95 % interval (mm)."""
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
    """Pairs of the paper's rows with the opposite order here, in words."""
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
