"""Options that describe a printed calibration board."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.core.errors import InputError

if TYPE_CHECKING:
    from longarm_comp.devices.stereo import CharucoTarget

_SQUARE_MM, _TAG_SHARE = 25.0, 0.72


def board(default: str | None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Options ``--board``, ``--square-mm``, ``--tag-mm``, ``--dictionary``."""

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option("--dictionary", default="DICT_5X5_100", show_default=True,
                         help="Tag family of the board, another than the marker's."),
            click.option("--tag-mm", type=float, default=None,
                         help="Side of its tags. Default: 0.72 squares."),
            click.option("--square-mm", type=float, default=_SQUARE_MM, show_default=True,
                         help="Side of its squares, measured on the print."),
            click.option("--board", default=default, show_default=default is not None,
                         metavar="COLUMNSxROWS", help="ChArUco board: squares across and down."),
        ):  # fmt: skip
            function = option(function)
        return function

    return add


def board_of(size: str, square_mm: float, tag_mm: float | None, dictionary: str) -> CharucoTarget:
    """The board. Raises InputError."""
    from longarm_comp.devices.stereo import CharucoTarget

    found = re.fullmatch(r"(\d{1,3})x(\d{1,3})", size)
    if found is None:
        raise InputError("board", "--board", size, "COLUMNSxROWS, for instance 7x5")
    tag = square_mm * _TAG_SHARE if tag_mm is None else tag_mm
    return CharucoTarget(square_mm / 1e3, tag / 1e3, int(found[1]), int(found[2]), dictionary)
