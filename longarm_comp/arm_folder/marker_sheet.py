"""A marker or a calibration board as a page in true size, with a ruler to check the print by."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.constants import inch, milli

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_bytes
from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard
from longarm_comp.sim.cameras import charuco_plate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPERS = {"A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "A1": (594, 841), "A0": (841, 1189)}
_RIM, _FOOT = 12.0, 34.0
"""Least margin, and room for the ruler and the text below the marker, mm."""
Printed = TagBoard | CharucoTarget


def lay_out_sheet(board: Printed) -> tuple[str, Figure]:
    """Return the name of the smallest paper that the marker fits on, and the page in true size.

    Raises:
        InputError: the marker does not fit on A0.
    """
    from matplotlib.figure import Figure

    grid = np.array([board.columns, board.rows])
    what = f"{board.dictionary}, tag {1e3 * board.tag_m:g} mm"
    if isinstance(board, CharucoTarget):
        size, quiet = 1e3 * board.square_m * grid, 200.0 * board.square_m
        square = f"square {1e3 * board.square_m:g} mm"
        what = f"ChArUco {board.columns}x{board.rows}, {square}, {what}"
    else:
        apart = board.tag_m + board.gap_m
        size, quiet = 1e3 * (grid * apart - board.gap_m), 200.0 * board.tag_m
        what += f", gap {1e3 * board.gap_m:g} mm"
    needed = size + 2 * (quiet + _RIM) + (0.0, _FOOT)
    paper = next((p for p, s in PAPERS.items() if (needed <= s).all()), None)
    if paper is None:
        wide, high = (f"{value:.0f}" for value in needed)
        raise InputError("marker", "size", f"{wide} x {high} mm", "a marker that fits on A0")
    width, height = PAPERS[paper]
    figure = Figure(figsize=(width * milli / inch, height * milli / inch))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    left, top = (width - size[0]) / 2, height - _RIM - quiet
    if isinstance(board, CharucoTarget):  # as OpenCV draws it; its corners are whole pixels
        whole = board.square_m, board.tag_m, board.columns, board.rows
        cells = charuco_plate(*whole, board.dictionary).texture
        _draw_cells(axes, cells, left, top, *size)
    else:
        pitch, side = 1e3 * apart, 1e3 * board.tag_m
        family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        for index in range(board.columns * board.rows):
            row, column = divmod(index, board.columns)
            tag, pixels = board.first_id + index, family.markerSize + 2
            cells = cv2.aruco.generateImageMarker(family, tag, pixels)
            _draw_cells(axes, cells, left + column * pitch, top - row * pitch, side, side)
    low = top - size[1] - quiet - 8.0
    how = "Print at 100 %, measure the ruler, mount it flat."
    axes.text(width / 2, low, f"{what}. {how}", ha="center", fontsize=8)
    y = low - 6.0
    for k in range(101):
        length = 5.0 if k % 10 == 0 else 3.5 if k % 5 == 0 else 2.0
        x = width / 2 - 50.0 + k
        axes.plot([x, x], [y, y - length], color="black", lw=0.3)
        if k % 50 == 0:
            axes.text(x, y - 9.0, f"{k} mm", ha="center", fontsize=7)
    return paper, figure


def write_sheet(board: Printed, path: Path) -> str:
    """Write the page as PDF and return the paper's name."""
    paper, figure = lay_out_sheet(board)
    page = io.BytesIO()
    # As fine as printers: an edge is where it belongs to 0.02 mm
    figure.savefig(page, format="pdf", dpi=600, metadata={"Creator": "longarm"})
    write_bytes(path, page.getvalue())
    return paper


def _draw_cells(
    axes: Axes, cells: np.ndarray, left: float, top: float, wide: float, high: float
) -> None:
    """Draw black and white cells; left, top: their corner, mm."""
    area = (left, left + wide, top - high, top)
    axes.imshow(
        cells, "gray", aspect="auto", interpolation="nearest", vmin=0, vmax=255, extent=area
    )
