"""Picture of where the tip came to rest: tip - target of several runs over the same targets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.report.style import INK, LOOKS

_MM = 1e3
_LEAST_MM = 1e-3


def at_the_tip(errors: Mapping[str, np.ndarray]) -> Figure:
    """Share of targets below an error, and the error along each axis.

    Args:
        errors: by name of the run, (N, 3) tip - target, m, without lost markers.
    """
    drawn = Figure(figsize=(9, 3.8))
    left, right = drawn.subplots(1, 2, width_ratios=(1.15, 1))
    looks = list(LOOKS.values())
    width = 0.8 / max(1, len(errors))
    for k, (name, error) in enumerate(errors.items()):
        look = looks[k % len(looks)]
        length = np.sort(np.linalg.norm(error, axis=1)) * _MM
        share = (np.arange(len(length)) + 1) / max(1, len(length))
        left.plot(
            np.maximum(length, _LEAST_MM), share, label=name, color=look.color,
            linestyle=look.dash, marker=look.marker, markersize=5,
            markevery=max(1, len(length) // 8),
        )  # fmt: skip
        at = np.arange(3) + (k - (len(errors) - 1) / 2) * width
        boxes = right.boxplot(
            list((error * _MM).T), positions=at, widths=width * 0.8, patch_artist=True,
            whis=(0, 100), medianprops={"color": INK, "linewidth": 1.5},
        )  # fmt: skip
        for box in boxes["boxes"]:
            box.set(facecolor="white", edgecolor=look.color, hatch=look.hatch)
    left.set(
        xscale="log", ylim=(0, 1.02), xlabel="|tip − target|, mm (log scale)",
        ylabel="share of targets", title="Share of targets below an error",
    )  # fmt: skip
    left.legend(fontsize=8, loc="best")
    right.axhline(0, color=INK, linewidth=0.8)
    right.set_xticks(range(3), ["x", "y", "z"])
    right.set(
        ylabel="tip − target, mm", yscale="symlog", title="Per axis: quartiles and range\n(from "
        "left to right in the order of the legend)",
    )  # fmt: skip
    drawn.subplots_adjust(left=0.07, right=0.99, bottom=0.13, top=0.86, wspace=0.2)
    return drawn
