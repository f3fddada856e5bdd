"""The marker of a folder as a page to print, to scale, with a ruler to check the print by."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path
from longarm_comp.devices.stereo import TagBoard

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPERS = {"A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "A1": (594, 841), "A0": (841, 1189)}
_RIM, _FOOT = 12.0, 34.0
"""Least margin, and room for the ruler and the text below the marker, mm."""
_INCH = 25.4


def sheet(board: TagBoard) -> tuple[str, Figure]:
    """The smallest paper that the marker fits on, and the page in true size.

    Raises:
        InputError: it fits on no paper up to A0.
    """
    from matplotlib.figure import Figure

    pitch, tag = 1e3 * (board.tag_m + board.gap_m), 1e3 * board.tag_m
    size = np.array([board.columns, board.rows]) * pitch - 1e3 * board.gap_m
    quiet = 0.2 * tag  # white about the marker
    needed = size + 2 * (quiet + _RIM) + (0.0, _FOOT)
    paper = next((p for p, s in PAPERS.items() if (needed <= s).all()), None)
    if paper is None:
        wide, high = (f"{value:.0f}" for value in needed)
        raise InputError("marker", "size", f"{wide} x {high} mm", "a marker that fits on A0")
    width, height = PAPERS[paper]
    figure = Figure(figsize=(width / _INCH, height / _INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    left, top = (width - size[0]) / 2, height - _RIM - quiet
    for index in range(board.columns * board.rows):
        row, column = divmod(index, board.columns)
        _draw_tag(axes, board, board.first_id + index, left + column * pitch, top - row * pitch)
    low = top - size[1] - quiet - 8.0
    said = f"{board.dictionary}, tag {tag:g} mm, gap {1e3 * board.gap_m:g} mm."
    how = "Print at 100 %, measure the ruler, mount it flat."
    axes.text(width / 2, low, f"{said} {how}", ha="center", fontsize=8)
    _draw_ruler(axes, width / 2, low - 6.0)
    return paper, figure


def write_sheet(board: TagBoard, path: Path) -> str:
    """Write the page as PDF and return the paper's name."""
    paper, figure = sheet(board)
    with atomic_path(path) as partial:
        figure.savefig(partial, format="pdf")
    return paper


def _draw_tag(axes: Axes, board: TagBoard, number: int, left: float, top: float) -> None:
    """Black square with white cells; left, top: its corner, mm."""
    from matplotlib.patches import Rectangle

    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    cells = cv2.aruco.generateImageMarker(family, number, family.markerSize + 2)
    cell = 1e3 * board.tag_m / len(cells)
    side = 1e3 * board.tag_m
    axes.add_patch(Rectangle((left, top - side), side, side, color="black", lw=0))
    for row, column in np.argwhere(cells > 0):
        corner = (left + column * cell, top - (row + 1) * cell)
        axes.add_patch(Rectangle(corner, cell, cell, color="white", lw=0))


def _draw_ruler(axes: Axes, middle: float, y: float) -> None:
    """100 mm with a mark every millimetre."""
    for k in range(101):
        length = 5.0 if k % 10 == 0 else 3.5 if k % 5 == 0 else 2.0
        x = middle - 50.0 + k
        axes.plot([x, x], [y, y - length], color="black", lw=0.3)
        if k % 50 == 0:
            axes.text(x, y - 9.0, f"{k} mm", ha="center", fontsize=7)
