"""One picture of many arms: what each of their models leaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.report.style import BLUE, GREEN, ORANGE, rc, save

_COLORS = (ORANGE, BLUE, GREEN)


def draw(names: Sequence[str], left: Mapping[str, Sequence[float | None]], path: Path) -> None:
    """Bars an arm, one a model that is known of any, mm.

    Args:
        names: of the arms.
        left: errors by model, mm; None where there is none.
        path: file to write.
    """
    shown = {k: v for k, v in left.items() if any(value is not None for value in v)}
    with rc():
        figure = Figure(figsize=(7.6, 1.2 + 0.5 * len(names)), layout="constrained")
        axes = figure.subplots()
        place = np.arange(len(names))
        height = 0.8 / max(len(shown), 1)
        for k, (model, values) in enumerate(shown.items()):
            lengths = [np.nan if value is None else value for value in values]
            at = place + (k - (len(shown) - 1) / 2) * height
            axes.barh(at, lengths, height, color=_COLORS[k], label=model)
        axes.set_yticks(place, names)
        axes.invert_yaxis()
        axes.set_xlabel("mean error, mm")
        if shown:
            axes.legend()
        save(figure, path)
