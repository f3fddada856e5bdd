"""Errors and expectations as pictures, for notebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

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
