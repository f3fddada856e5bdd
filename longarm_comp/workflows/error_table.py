"""Errors of several models on the same rows, as a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from longarm_comp.core.html_table import html_table
from longarm_comp.core.identify.calibrate import Errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def bars(labels: Sequence[str], heights: Mapping[str, Sequence[float]], what: str) -> Figure:
    """Bars side by side, one colour for each of ``heights`` (mm), one place a label."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.add_subplot()
    width, at = 0.8 / len(heights), np.arange(len(labels))
    for k, (name, values) in enumerate(heights.items()):
        axes.bar(at + (k - (len(heights) - 1) / 2) * width, values, width, label=name)
    axes.set_xticks(at, labels, rotation=30 if len(labels) > 4 else 0)
    axes.set_ylabel(what)
    axes.legend()
    return figure


@dataclass(frozen=True, repr=False)
class ErrorTable(Mapping[str, Errors]):
    """Errors (m) as seen by model name, in the order of the ladder: ``table["calibrated"].mean``.

    `commanded`: the same as a command would have them (`core/data/commanded.py`).
    """

    errors: Mapping[str, Errors]
    commanded: Mapping[str, Errors]

    def __getitem__(self, name: str) -> Errors:
        return self.errors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.errors)

    def __len__(self) -> int:
        return len(self.errors)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """One row a model, in millimetres (and mrad), under the names of report.json."""
        return [_row(name, self[name], self.commanded[name]) for name in self]

    def _repr_html_(self) -> str:
        return html_table("errors on rows that were not fitted", self.rows)

    def plot(self) -> Figure:
        """Mean and 95 % of every model as bars."""
        rows = self.rows
        heights = {name: [row[f"{name}_mm"] for row in rows] for name in ("mean", "p95")}
        return bars([row["model"] for row in rows], heights, "error, mm")

    def __repr__(self) -> str:
        width = max(map(len, ("model", *self)))
        columns = list(self.rows[0])[2:] if self.errors else []
        head = (f"{column:>18}" for column in columns)
        lines = ["".join([f"{'model':<{width}}", f"{'n':>6}", *head])]
        for row in self.rows:
            cells = (f"{row[column]:18.3f}" for column in columns)
            lines.append("".join([f"{row['model']:<{width}}", f"{row['n']:6d}", *cells]))
        return "\n".join(lines)


def _row(name: str, errors: Errors, commanded: Errors) -> dict[str, Any]:
    mean, *others = errors.mm.items()
    both = dict([mean, ("commanded_mean_mm", commanded.mm["mean_mm"]), *others])
    row = {"model": name, "n": errors.n, **both}
    # Where the orientation was measured, and where points were touched: mean distance from them
    further = {"mean_mrad": errors.angle, "spread_mm": errors.spread}
    return {**row, **{name: 1e3 * v for name, v in further.items() if v is not None}}
