"""``longarm stereo webcams``."""

from __future__ import annotations

from pathlib import Path

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note


@click.command()
@options.written("--frames", "Folder for a picture of each.", outputs.never)
def command(frames: Path | None) -> None:
    """List the webcams, take a picture of each, and print what publishes two of them for ROS.

    \b
    Example:
      longarm stereo webcams --frames pictures
    """
    import cv2

    from longarm_comp.core.errors import JobError
    from longarm_comp.core.files import atomic_path
    from longarm_comp.devices.stereo.webcams import driver_lines, picture, webcams

    found = webcams()
    for camera in found:
        click.echo(f"{camera.device}  {camera.name}")
        if frames is not None:
            file = frames / f"{Path(camera.device).name}.png"
            with atomic_path(file) as partial:
                cv2.imwrite(str(partial), picture(camera.device))
            note(f"what it sees: {file}")
    if len(found) < 2:
        raise JobError("two webcams are needed", found=len(found))
    note("two nodes publish them; exchange left and right where the pictures say so:")
    for line in driver_lines(*(camera.device for camera in found[:2])):
        click.echo(line)
