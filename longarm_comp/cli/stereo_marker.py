"""``longarm stereo marker``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import board_options, options, outputs
from longarm_comp.cli.output import note
from longarm_comp.core.errors import InputError

if TYPE_CHECKING:
    from longarm_comp.devices.stereo import CharucoTarget, TagBoard


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), metavar="[DIR]", required=False)
@board_options.board(None)
@options.output("marker.pdf", "Page to print.", outputs.PICTURE)
def command(
    folder: Path | None,
    board: str | None,
    square_mm: float,
    tag_mm: float | None,
    dictionary: str,
    output: Path,
) -> None:
    """Write the marker of DIR/stereo_bridge.yaml, or a calibration board, in true size.

    The page has a ruler of 100 mm: measure it, because printers scale. Then measure the tags and
    set tag_m and gap_m, or say the board's --square-mm to `longarm stereo calibrate`.

    \b
    Examples:
      longarm stereo marker my_arm -o marker.pdf
      longarm stereo marker --board 7x5 --square-mm 25 -o board.pdf
    """
    from longarm_comp.arm_folder.marker_sheet import write_sheet

    if (folder is None) == (board is None):
        given = "neither" if folder is None else "both"
        raise InputError("stereo marker", "DIR, --board", given, "one of the two")
    if board is not None:
        target = board_options.board_of(board, square_mm, tag_mm, dictionary)
        paper = write_sheet(target, output)
    else:
        assert folder is not None
        paper = write_sheet(_marker(folder), output)
    note(f"{output}: {paper}, to be printed at 100 %")


def _marker(folder: Path) -> CharucoTarget | TagBoard:
    from longarm_comp.arm_folder.parameter_file import parameters_of
    from longarm_comp.devices.stereo.marker import marker_of

    return marker_of(parameters_of("stereo_bridge", folder / "stereo_bridge.yaml"))
