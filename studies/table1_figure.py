"""The figure of Table I: the paper's Fig. 6 with its spread over the arms."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from longarm_comp.report.style import BLUE, INK, ORANGE, rc, save


def draw_table1(rows: Sequence[Mapping[str, Any]], path: Path, title: str = "") -> None:
    """Draw the paper's Fig. 6: mean |z| of each row beside the paper's own figure.

    A bar reaches to the mean over the arms, its whisker from the 10th to the 90th percentile,
    dots are the single arms.

    Args:
        rows: `row`, `arms_mm` and `paper_mean_abs_z_mm` (None where the paper has no such row), in
            the order to draw.
        path: file to write, by its ending PNG, SVG or PDF.
        title: above the figure.
    """
    with rc():
        drawn = Figure(figsize=(max(6.0, 1.25 * len(rows) + 1.2), 4.4), layout="constrained")
        axes = drawn.subplots()
        axes.set_title(title)
        for k, row in enumerate(rows):
            values = np.asarray(row["arms_mm"], dtype=float)
            _draw_spread(axes, k - 0.2, values, f"here, {len(values)} arms" if k == 0 else "")
            paper = row["paper_mean_abs_z_mm"]
            if paper is not None:
                named = any(r["paper_mean_abs_z_mm"] is not None for r in rows[:k])
                at, label = k + 0.2, "" if named else "the paper"
                axes.bar(at, paper, 0.36, color=ORANGE, edgecolor=INK, label=label)
                _annotate(axes, at, paper, f"{paper:.2f}")
        axes.set_xticks(range(len(rows)), [_fold(row["row"]) for row in rows], fontsize=8)
        axes.set_ylabel("mean |z| error, mm")
        axes.grid(axis="x", visible=False)
        axes.legend()
        save(drawn, path)


def _draw_spread(axes: Axes, at: float, values: np.ndarray, label: str) -> None:
    mean = float(values.mean())
    low, high = np.percentile(values, [10, 90])
    # The mean may lie outside the percentiles when one arm is far worse than the others.
    whisker = [[max(0.0, mean - low)], [max(0.0, high - mean)]]
    axes.bar(at, mean, 0.36, color="white", edgecolor=BLUE, hatch="//", label=label)
    axes.errorbar(at, mean, yerr=whisker, color=INK, capsize=4, linewidth=1.4)
    aside = at + 0.1 * ((np.arange(len(values)) * 0.618034 % 1) - 0.5)
    axes.plot(aside, values, linestyle="", marker="o", markersize=2.5, color=INK, alpha=0.35)
    _annotate(axes, at, float(values.max()), f"{mean:.2f}")


def _annotate(axes: Axes, at: float, height: float, text: str) -> None:
    axes.annotate(text, (at, height), (0, 4), textcoords="offset points", ha="center")


def _fold(text: str) -> str:
    """Fold a label into two or three short lines."""
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) > 12 and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
