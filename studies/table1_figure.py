"""The figure of Table I: the paper's Fig. 6 with its spread over the arms."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from longarm_comp.core.errors import InputError
from longarm_comp.report.style import BLUE, INK, ORANGE, rc, save

_FORMATS = {".png", ".svg", ".pdf"}


class Table1Row(TypedDict):
    """A row of Table I, once per arm or seed, beside the paper's own figure.

    ``paper_mm`` is None where the paper has no such row.
    """

    row: str
    mean_abs_z_mm: Sequence[float]
    paper_mm: float | None


def table1_figure(
    rows: Sequence[Table1Row], path: str | os.PathLike[str], *, title: str = ""
) -> Path:
    """The paper's Fig. 6: mean |z| per row, its spread over the arms, beside the paper's figures.

    A bar reaches to the mean over the arms, its whisker from the 10th to the 90th percentile,
    dots are the single arms.

    Args:
        rows: in the order to draw.
        path: file to write, by its ending PNG, SVG or PDF.
        title: above the figure.

    Raises:
        InputError: no rows, a row without values or not finite, an unknown ending.
    """
    _check_rows(rows)
    with rc():
        drawn = Figure(figsize=(max(6.0, 1.25 * len(rows) + 1.2), 4.4), layout="constrained")
        axes = drawn.subplots()
        axes.set_title(title)
        for k, row in enumerate(rows):
            _spread_bar(axes, k - 0.2, np.asarray(row["mean_abs_z_mm"], dtype=float), k == 0)
            paper = row["paper_mm"]
            if paper is not None:
                _paper_bar(axes, k + 0.2, paper, any(r["paper_mm"] is not None for r in rows[:k]))
        axes.set_xticks(range(len(rows)), [_folded(row["row"]) for row in rows], fontsize=8)
        axes.set_ylabel("mean |z| error, mm")
        axes.grid(axis="x", visible=False)
        axes.legend()
        return _saved(drawn, path)


def _spread_bar(axes: Axes, at: float, values: np.ndarray, labelled: bool) -> None:
    mean = float(values.mean())
    low, high = np.percentile(values, [10, 90])
    # The mean may lie outside the percentiles when one arm is far worse than the others.
    whisker = [[max(0.0, mean - low)], [max(0.0, high - mean)]]
    axes.bar(
        at,
        mean,
        0.36,
        color="white",
        edgecolor=BLUE,
        hatch="//",
        label=f"here, {len(values)} arms" if labelled else None,
    )
    axes.errorbar(at, mean, yerr=whisker, color=INK, capsize=4, linewidth=1.4)
    aside = at + 0.1 * ((np.arange(len(values)) * 0.618034 % 1) - 0.5)
    axes.plot(aside, values, linestyle="", marker="o", markersize=2.5, color=INK, alpha=0.35)
    axes.annotate(
        f"{mean:.2f}", (at, float(values.max())), (0, 4), textcoords="offset points", ha="center"
    )


def _paper_bar(axes: Axes, at: float, value: float, labelled: bool) -> None:
    label = None if labelled else "the paper"
    axes.bar(at, value, 0.36, color=ORANGE, edgecolor=INK, label=label)
    axes.annotate(f"{value:.2f}", (at, value), (0, 4), textcoords="offset points", ha="center")


def _folded(text: str) -> str:
    """A label on two or three short lines."""
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) > 12 and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _check_rows(rows: Sequence[Table1Row]) -> None:
    if not rows:
        raise InputError("table 1 figure", "rows", "none", "at least one row")
    for row in rows:
        paper = row["paper_mm"]
        _check_values(row["row"], [*row["mean_abs_z_mm"], *([] if paper is None else [paper])])
        if len(row["mean_abs_z_mm"]) == 0:
            raise InputError("table 1 figure", row["row"], "no values", "one value an arm")


def _check_values(name: str, values: Sequence[float]) -> None:
    if not np.isfinite(np.asarray(values, dtype=float)).all():
        raise InputError("figure", name, list(values), "finite numbers, mm")


def _saved(drawn: Figure, path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if target.suffix not in _FORMATS:
        raise InputError(target, "ending", target.suffix, ", ".join(sorted(_FORMATS)))
    save(drawn, target)
    return target
