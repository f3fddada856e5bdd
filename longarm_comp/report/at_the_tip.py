"""Picture of errors: of models on a hold-out, or of the tip from its targets in several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.report.noise_floor import normal_length
from longarm_comp.report.style import FLOOR, INK, LOOKS, Look

_MM = 1e3


def at_the_tip(
    errors: Mapping[str, np.ndarray],
    looks: Sequence[Look] = tuple(LOOKS.values()),
    *,
    rows: str = "targets",
    error: str = "tip − target",
    sigma_mm: tuple[float, float, float] | None = None,
) -> Figure:
    """Share of rows below an error, and the error along each axis.

    Errors are (N, 3) m by name of the run, without lost markers. ``rows``, ``error``: what they are
    called; ``sigma_mm``: noise along each axis, drawn as a floor.
    """
    drawn = Figure(figsize=(9, 3.8))
    left, right = drawn.subplots(1, 2, width_ratios=(1.15, 1))
    width = 0.8 / max(1, len(errors))
    for k, (name, held) in enumerate(errors.items()):
        look = looks[k % len(looks)]
        length = np.sort(np.linalg.norm(held, axis=1)) * _MM
        share = (np.arange(len(length)) + 1) / max(1, len(length))
        left.plot(
            np.maximum(length, 1e-4), share, label=name, color=look.color,
            linestyle=look.dash, marker=look.marker, markersize=5,
            markevery=max(1, len(length) // 8),
        )  # fmt: skip
        at = np.arange(3) + (k - (len(errors) - 1) / 2) * width
        boxes = right.boxplot(
            list((held * _MM).T), positions=at, widths=width * 0.8, patch_artist=True,
            whis=(2.5, 97.5), showfliers=False, medianprops={"color": INK, "linewidth": 1.5},
        )  # fmt: skip
        for box in boxes["boxes"]:
            box.set(facecolor="white", edgecolor=look.color, hatch=look.hatch)
    if sigma_mm is not None:
        scale = float(np.sqrt(np.mean(np.square(sigma_mm))))
        below = np.linspace(0.005, 0.995, 200)
        left.plot(scale * normal_length(below), below, color=INK, linewidth=1, label=FLOOR)
    left.set(
        xscale="log", ylim=(0, 1.02), xlabel=f"|{error}|, mm (log scale)",
        ylabel=f"share of {rows}", title=f"Share of {rows} below an error",
    )  # fmt: skip
    left.legend(fontsize=8, loc="best")
    right.axhline(0, color=INK, linewidth=0.8)
    right.set_xticks(range(3), ["x", "y", "z"])
    right.set(
        ylabel=f"{error}, mm", yscale="symlog", title="Per axis: quartiles and 95 % range\n(from "
        "left to right in the order of the legend)",
    )  # fmt: skip
    drawn.subplots_adjust(left=0.07, right=0.99, bottom=0.13, top=0.86, wspace=0.2)
    return drawn
