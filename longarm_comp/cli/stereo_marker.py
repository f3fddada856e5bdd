"""``longarm stereo marker``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@options.output("marker.pdf", "Page to print.")
def command(folder: Path, output: Path) -> None:
    """Write the marker of DIR/stereo_bridge.yaml as a page to print, in true size.

    The page has a ruler of 100 mm: measure it, because printers scale. Then measure the tags and
    set tag_m and gap_m.

    \b
    Example:
      longarm stereo marker my_arm -o marker.pdf
    """
    from longarm_comp.arm_folder.marker_sheet import write_sheet
    from longarm_comp.arm_folder.parameter_file import own_parameters, read_parameters
    from longarm_comp.arm_folder.sight import board_of
    from longarm_comp.core.errors import InputError

    file = folder / "stereo_bridge.yaml"
    given = own_parameters("stereo_bridge") | read_parameters(file)
    if given["marker.kind"] != "tags":
        raise InputError(file, "marker.kind", given["marker.kind"], "tags")
    paper = write_sheet(board_of(given), output)
    note(f"{output}: {paper}, to be printed at 100 %")
