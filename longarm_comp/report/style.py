"""Style of all figures: Okabe and Ito's palette, with a marker, line or hatch per colour."""

import io
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from longarm_comp.core.files import write_bytes

INK = "#1a1a1a"
GRID = "#d9d9d9"
BLUE, ORANGE, GREEN, VERMILLION, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"


@dataclass(frozen=True)
class Look:
    """Label and style of a stage. No two share a colour, a line, a marker or a hatch."""

    label: str
    color: str
    dash: str | tuple[float, tuple[float, ...]]
    marker: str
    hatch: str


LOOKS = {
    "nominal": Look("nominal", INK, (0, (1, 1.2)), "X", ""),
    "frames_only": Look("frames only", PURPLE, (0, (5, 1.5, 1, 1.5)), "s", "xx"),
    "calibrated": Look("calibrated", ORANGE, (0, (5, 1.5)), "^", "//"),
    "with_effects": Look("+\u00a0effect", BLUE, "-", "o", ".."),
    "with_functions": Look("+\u00a0discovered", VERMILLION, (0, (3, 1)), "v", "++"),
    "with_network": Look("+\u00a0network", GREEN, (0, (8, 1.5, 1, 1.5, 1, 1.5)), "D", "\\\\"),
}
"""Stages of the before/after table, in the order in which they are built."""
FLOOR = "noise floor"

RC: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.facecolor": "white",
    "font.size": 9,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.facecolor": "white",
    "svg.fonttype": "path",
    "svg.hashsalt": "longarm",  # the same figure gives the same bytes
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}

SIGNED: Any = {
    "svg": {"Date": None, "Creator": "longarm"},
    "png": {"Software": "longarm"},
    "pdf": {"CreationDate": None, "Creator": "longarm", "Producer": None},
}
"""Metadata by which a command knows that it wrote a picture and may overwrite it."""


def is_signed(path: Path) -> bool:
    """Return whether a picture's metadata show that this package wrote it."""
    with path.open("rb") as file:
        return b"longarm" in file.read(4096)


# An SVG turns light on dark, hues kept, where the reader's pages are dark
_DARK = b"@media screen and (prefers-color-scheme: dark){svg{filter:invert(.9) hue-rotate(180deg)}}"


def rc() -> AbstractContextManager[None]:
    return mpl.rc_context(RC)


def svg(drawn: Figure) -> bytes:
    """Return the figure as SVG; the same figure gives the same bytes."""
    return _draw_content(drawn, "svg").replace(b"</style>", _DARK + b"</style>", 1)


def save(drawn: Figure, path: Path) -> None:
    """Write the figure to a file in the format of its ending, whole or not at all.

    The same figure gives the same bytes.
    """
    write_bytes(path, _draw_content(drawn, path.suffix.removeprefix(".").lower()))


def _draw_content(drawn: Figure, kind: str) -> bytes:
    # The axes are placed once; to save a figure with a layout engine would draw it twice
    engine = drawn.get_layout_engine()
    if engine is not None:
        engine.execute(drawn)
        drawn.set_layout_engine(None)
    held = io.BytesIO()
    drawn.savefig(held, format=kind, dpi=150, metadata=SIGNED[kind])
    return held.getvalue()
