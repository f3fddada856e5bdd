"""What the drawn pictures share: size, letters, colours, files."""

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from longarm_comp.report.style import BLUE, GREEN, INK, ORANGE, RC, VERMILLION, svg

__all__ = ["BLUE", "GREEN", "GREY", "INK", "ORANGE", "VERMILLION", "arrow", "bare", "save_svg"]

GREY = "#8a8a8a"
STYLE = {**RC, "font.size": 11, "axes.titlesize": 12, "axes.grid": False, "legend.fontsize": 10}
"""The report's style, in letters that can be read where a page shows the picture small."""


def save_svg(
    draw: Callable[[Figure], None], path: Path, size: tuple[float, float] = (7.6, 3.9)
) -> None:
    """Draw on a new figure of a size (inches) and write it; the same drawing, the same bytes."""
    with mpl.rc_context(STYLE):
        figure = plt.figure(figsize=size, layout="constrained")
        try:
            draw(figure)
            path.write_bytes(svg(figure))
        finally:
            plt.close(figure)


def arrow(
    axes: Axes, start: np.ndarray, stop: np.ndarray, color: str, *, width: float = 2.0,
    head: str = "-|>", dash: str = "-",
) -> None:  # fmt: skip
    """An arrow between two points of the data."""
    how = {"arrowstyle": head, "color": color, "lw": width, "ls": dash, "shrinkA": 0, "shrinkB": 0,
           "mutation_scale": 14}  # fmt: skip
    axes.annotate("", tuple(stop), tuple(start), arrowprops=how)


def bare(axes: Axes) -> None:
    """No axes around a sketch, and one scale for both directions."""
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
