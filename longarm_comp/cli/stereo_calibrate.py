"""``longarm stereo calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import board_options, options
from longarm_comp.cli.output import note, print_json, print_table, progress
from longarm_comp.core.errors import InputError

if TYPE_CHECKING:
    from longarm_comp.devices.stereo import Target
    from longarm_comp.devices.stereo.board_calibration import BoardCalibration
    from longarm_comp.devices.stereo.views import BoardView

    Size = tuple[int, int]


@click.command()
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@options.path_option("--images", "Folder of image pairs: left and right in their names.")
@click.option("--live", is_flag=True, help="Guided capture from left/ and right/image_raw.")
@board_options.board("7x5")
@options.path_option("--save", "Live: folder that the used images are written to.")
@click.option(
    "--within", type=float, default=600.0, show_default=True, help="Live: give up after so long, s."
)
@options.namespace
@options.as_json
def command(
    folder: Path,
    images: Path | None,
    live: bool,
    board: str,
    square_mm: float,
    tag_mm: float | None,
    dictionary: str,
    save: Path | None,
    within: float,
    namespace: str,
    as_json: bool,
) -> None:
    """Calibrate the stereo head from views of a printed board; write DIR/cameras/left.yaml, right.

    The views come from files, or from the topics: hold the board before the cameras, and it takes
    a pair whenever the board rests somewhere new, and says what is still missing. Views that are
    too few, blurred or one-sided are refused in words. The files are what ROS camera drivers take
    as camera_info_url. `longarm stereo marker --board 7x5` prints the board.

    \b
    Examples:
      longarm stereo calibrate my_arm --live
      longarm stereo calibrate my_arm --images pictures --board 7x5 --square-mm 25.1
    """
    from longarm_comp.arm_folder.camera_files import write_cameras
    from longarm_comp.devices.stereo.board_calibration import calibrated

    if (images is not None) == live:
        given = "both" if live else "neither"
        raise InputError("stereo calibrate", "--images, --live", given, "one of the two")
    if not folder.is_dir():
        raise InputError(folder, "DIR", "missing", "an arm's folder: `longarm init DIR`")
    target = board_options.board_of(board, square_mm, tag_mm, dictionary)
    if images is not None:
        views, size = _from_files(target, images)
    else:
        views, size = _from_topics(target, save, within, namespace)
    found = calibrated(target, views, size)
    files = write_cameras(folder, found)
    if as_json:
        print_json({"files": files, **_facts(found, size)})
        return
    rows = list(_facts(found, size).items())
    print_table("Stereo head", ("", "value"), rows)
    note(f"{files[0]} and {files[1]}: give them to the camera driver as camera_info_url")


def _from_files(target: Target, folder: Path) -> tuple[list[BoardView], Size]:
    from longarm_comp.devices.stereo import StereoRefusal
    from longarm_comp.devices.stereo.camera_file import pair_files, read_grey
    from longarm_comp.devices.stereo.views import view_of

    views: list[BoardView] = []
    size: Size | None = None
    pairs = pair_files(folder)
    with progress("views") as tell:
        for k, (left, right) in enumerate(pairs):
            tell(left.name, k / len(pairs))
            greys = read_grey(left), read_grey(right)
            height, width = greys[0].shape
            size = size or (width, height)
            if size != (width, height):
                allowed = f"{size[0]}x{size[1]} as the others"
                raise InputError(left, "size", f"{width}x{height}", allowed)
            try:
                views.append(view_of(target, *greys))
            except StereoRefusal as refusal:
                note(f"{left.name}, {right.name} are left out: {refusal}")
    assert size is not None
    return views, size


def _from_topics(
    target: Target, save: Path | None, within: float, namespace: str
) -> tuple[list[BoardView], Size]:
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.board_capture import capture

    last = ""

    def tell(text: str) -> None:
        nonlocal last
        if text != last:
            note(text)
        last = text

    with stop_on_signals() as stop:
        return capture(target, within, tell, namespace=namespace, stop=stop, save=save)


def _facts(found: BoardCalibration, size: Size) -> dict[str, object]:
    fit = found.fit
    return {
        "size_px": f"{size[0]}x{size[1]}",
        "focal_left_px": float(fit.rig.left.k[0, 0]),
        "focal_right_px": float(fit.rig.right.k[0, 0]),
        "baseline_mm": 1e3 * fit.rig.baseline_m,
        "views_used": len(fit.used),
        "views_left_out": len(fit.rejected),
        "reprojection_rms_px": fit.rms_px,
        "held_out_views": found.held_out,
        "held_out_rms_mm": found.held_out_mm,
        "nearest_m": found.distances_m[0],
        "farthest_m": found.distances_m[1],
    }
