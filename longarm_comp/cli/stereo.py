"""``longarm stereo marker``, ``webcams``, ``calibrate`` and ``hand-eye``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json, print_table, progress
from longarm_comp.cli.signals import on_graph
from longarm_comp.core.errors import InputError

if TYPE_CHECKING:
    from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard, Target
    from longarm_comp.devices.stereo.views import BoardView

    Size = tuple[int, int]

_SQUARE_MM, _TAG_SHARE = 25.0, 0.72
"""Defaults of a board: side of its squares, mm, and side of its tags as a share of that.

A 7x5 board of such squares fills A4. The white around a tag lets its edge be found.
"""


def _board_options(default: str | None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds the options of a board, which `_target_of` takes."""
    return options.several(
        click.option(
            "--board",
            default=default,
            metavar="COLUMNSxROWS",
            help="ChArUco board: squares across and down.",
        ),
        click.option(
            "--square-mm",
            type=float,
            default=_SQUARE_MM,
            help="Side of its squares, measured on the print.",
        ),
        click.option("--tag-mm", type=float, help="Side of its tags. Default: 0.72 squares."),
        click.option(
            "--dictionary",
            default="DICT_5X5_100",
            help="Tag family of the board; it must differ from the marker's.",
        ),
    )


def _target_of(
    board: str, square_mm: float, tag_mm: float | None, dictionary: str
) -> CharucoTarget:
    from longarm_comp.devices.stereo.target import CharucoTarget

    found = re.fullmatch(r"(\d{1,3})x(\d{1,3})", board)
    if found is None:
        raise InputError("board", "--board", board, "COLUMNSxROWS, for instance 7x5")
    tag = square_mm * _TAG_SHARE if tag_mm is None else tag_mm
    return CharucoTarget(square_mm / 1e3, tag / 1e3, int(found[1]), int(found[2]), dictionary)


@click.command()
@options.path_argument("folder", "[DIR]", required=False)
@_board_options(None)
@options.output("marker.pdf", "Page to print.", outputs.PICTURE)
def marker(folder: Path | None, board: str | None, output: Path, **size: Any) -> None:
    """Write the marker of DIR/stereo_bridge.yaml, or a calibration board, in true size.

    The page has a ruler of 100 mm: measure it, because printers scale. Then measure the tags and
    set tag_m and gap_m, or give the board's --square-mm to `longarm stereo calibrate`.

    \b
    Examples:
      longarm stereo marker my_arm -o marker.pdf
      longarm stereo marker --board 7x5 --square-mm 25 -o board.pdf
    """
    from longarm_comp.arm_folder.marker_sheet import write_sheet
    from longarm_comp.arm_folder.parameter_file import parameters_of
    from longarm_comp.devices.stereo.target import TagBoard

    if (folder is None) == (board is None):
        given = "neither" if folder is None else "both"
        raise InputError("stereo marker", "DIR, --board", given, "one of the two")
    printed: CharucoTarget | TagBoard
    if board is not None:
        printed = _target_of(board, **size)
    else:
        assert folder is not None
        printed = TagBoard.of(parameters_of("stereo_bridge", folder / "stereo_bridge.yaml"))
    paper = write_sheet(printed, output)
    note(f"{output}: {paper}, to be printed at 100 %")


@click.command()
@options.written_option("--frames", "Folder for a picture of each.", outputs.never)
def webcams(frames: Path | None) -> None:
    """List the webcams, take a picture of each, and print the commands that publish two of them for
    ROS.

    \b
    Example:
      longarm stereo webcams --frames pictures
    """
    import cv2

    from longarm_comp.core.errors import JobError
    from longarm_comp.core.files import write_bytes
    from longarm_comp.devices.stereo.webcams import picture, webcams, write_driver_commands

    found = webcams()
    for camera in found:
        click.echo(f"{camera.device}  {camera.name}")
        if frames is not None:
            file = frames / f"{Path(camera.device).name}.png"
            write_bytes(file, cv2.imencode(".png", picture(camera.device))[1].tobytes())
            note(f"what it sees: {file}")
    if len(found) < 2:
        raise JobError("two webcams are needed", found=len(found))
    note("two nodes publish them; exchange left and right where the pictures say so:")
    for line in write_driver_commands(*(camera.device for camera in found[:2])):
        click.echo(line)


@click.command()
@options.folder
@options.path_option("--images", "Folder of image pairs: left and right in their names.")
@options.flag("--live", "Take the views from left/ and right/image_raw, with guidance.")
@_board_options("7x5")
@options.path_option("--save", "Live: folder that the used images are written to.")
@options.namespace
@options.as_json
def calibrate(
    folder: Path, images: Path | None, live: bool, save: Path | None, namespace: str, **board: Any
) -> None:
    """Calibrate the two cameras from views of a printed board; write DIR/cameras/left.yaml, right.

    The views come from files or from the topics. For the topics, hold the board before the cameras:
    the command takes a pair whenever the board rests at a new place, and says which views are still
    missing. Views that are too few, blurred or one-sided are refused with the reason. ROS camera
    drivers take the files as camera_info_url. `longarm stereo marker --board 7x5` prints the board.

    \b
    Examples:
      longarm stereo calibrate my_arm --live
      longarm stereo calibrate my_arm --images pictures --board 7x5 --square-mm 25.1
    """
    from longarm_comp.arm_folder.measured import write_cameras
    from longarm_comp.devices.stereo.calibrate import calibrate_board

    if (images is not None) == live:
        given = "both" if live else "neither"
        raise InputError("stereo calibrate", "--images, --live", given, "one of the two")
    if not folder.is_dir():
        raise InputError(folder, "DIR", "missing", "an arm's folder: `longarm init DIR`")
    target = _target_of(**board)
    if images is not None:
        views, size = _from_files(target, images)
    else:
        from longarm_comp.jobs.board_capture import capture

        last = ""

        def tell(text: str) -> None:
            nonlocal last
            if text != last:
                note(text)
            last = text

        with on_graph("board_capture", namespace) as client:
            views, size = capture(client, target, tell, save=save)
    found = calibrate_board(target, views, size)
    files = write_cameras(folder, found)
    fit = found.fit
    facts = {
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
    print_json({"files": files, **facts})
    print_table("Stereo head", ("", "value"), list(facts.items()))
    note(f"{files[0]} and {files[1]}: give them to the camera driver as camera_info_url")
    if any(file.with_suffix(".previous.yaml").is_file() for file in files):
        note(f"the files of before are kept in {files[0].parent}: *.previous.yaml")


def _from_files(target: Target, folder: Path) -> tuple[list[BoardView], Size]:
    from longarm_comp.devices.stereo.camera_file import pair_files, read_grey
    from longarm_comp.devices.stereo.refusal import StereoRefusal
    from longarm_comp.devices.stereo.views import find_view

    views: list[BoardView] = []
    size: Size = (0, 0)
    pairs = pair_files(folder)
    with progress("views") as tell:
        for k, (left, right) in enumerate(pairs):
            tell(left.name, k / len(pairs))
            greys = read_grey(left), read_grey(right)
            height, width = greys[0].shape
            if size not in ((0, 0), (width, height)):
                allowed = f"{size[0]}x{size[1]} as the others"
                raise InputError(left, "size", f"{width}x{height}", allowed)
            size = width, height
            try:
                views.append(find_view(target, *greys))
            except StereoRefusal as refusal:
                note(f"{left.name}, {right.name} are left out: {refusal}")
    return views, size


@click.command("hand-eye")
@options.folder
@options.session
@options.model
@options.as_json
def hand_eye(folder: Path, session: Path, model: Path | None) -> None:
    """Find where the two cameras stand, and write it into DIR/stereo_bridge.yaml.

    SESSION (CSV or bag) must be measured with the hand_eye that is in the file now. You may give
    the same session again, because the earlier value is kept in measured.yaml. The arm's own errors
    increase the residual; a calibrated --model makes it smaller. DIR/simulated_arm.yaml is changed
    too.

    \b
    Example:
      longarm stereo hand-eye my_arm my_arm/session --model my_arm/model.yaml
    """
    from longarm_comp.arm_folder.measured import head_at, write_head
    from longarm_comp.core.arm import quaternion
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.jobs.camera_placement import placed_cameras
    from longarm_comp.sessions.read import read_session
    from longarm_comp.workflows.inputs import choose_physics

    arm = Arm.load(folder / "arm.yaml")
    rows = read_session(session, arm)
    assumed = head_at(folder, rows.hash)
    found = placed_cameras(choose_physics(arm, model), rows, assumed)
    quality = {
        "rows": found.rows,
        "outliers": found.outliers,
        "position_sd_mm": [round(float(v), 3) for v in found.position_sd_mm],
        "rotation_sd_deg": [round(float(v), 4) for v in found.rotation_sd_deg],
        "residual_mm": round(found.residual_mm, 3),
        "held_out_mm": round(found.held_out_mm, 3),
    }
    written = write_head(folder, found.pose, assumed, rows.hash, quality)
    place, turn = found.pose[:3, 3], quaternion.from_rotation(found.pose[:3, :3])
    print_json({"files": written, "xyz": place, "quaternion": turn, **quality})
    by_axis = zip("xyz", place, found.position_sd_mm, turn[:3], found.rotation_sd_deg, strict=True)
    lines, turns = [], []
    for axis, value, sd, part, turn_sd in by_axis:
        lines.append((f"{axis}, m", f"{value:.4f}", f"{sd:.2f} mm"))
        turns.append((f"q{axis}", f"{part:.5f}", f"{turn_sd:.3f} deg"))
    lines += [*turns, ("qw", f"{turn[3]:.5f}", "")]
    print_table("Left camera in the base frame", ("", "value", "1 sigma"), lines)
    note(
        f"{found.rows} rows, {found.outliers} left out as outliers; residual "
        f"{found.residual_mm:.2f} mm, on rows held out {found.held_out_mm:.2f} mm"
    )
    note(f"it was assumed {found.moved_mm:.1f} mm and {found.turned_deg:.2f} deg from there")
    note(f"{' and '.join(written)} written: a running graph reads them when it is started again")
    if arm.camera is not None:
        off = math.dist(arm.camera.position_m, place)
        if off > 0.01:
            note(
                f"arm.yaml has its camera {1e3 * off:.0f} mm from there: put position_m and "
                "optical_axis right before the next calibration"
            )
