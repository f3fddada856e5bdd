"""``longarm stereo hand-eye``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_table
from longarm_comp.core.errors import InputError

if TYPE_CHECKING:
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.data.session import Session
    from longarm_comp.jobs.camera_placement import HeadPlacement


@click.command("hand-eye")
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
@click.argument("session", type=click.Path(path_type=Path), required=False)
@click.option("--live", is_flag=True, help="From joint_states and tip_measured, pose by pose.")
@click.option("--poses", type=click.IntRange(10), default=20, show_default=True, help="Live.")
@click.option(
    "--within", type=float, default=900.0, show_default=True, help="Live: give up after so long, s."
)
@options.model
@click.option("--free-tip", is_flag=True, help="The seen point's place on the tip is unknown too.")
@click.option("--dry-run", is_flag=True, help="Write nothing.")
@options.namespace
@options.as_json
def command(
    folder: Path,
    session: Path | None,
    live: bool,
    poses: int,
    within: float,
    model: Path | None,
    free_tip: bool,
    dry_run: bool,
    namespace: str,
    as_json: bool,
) -> None:
    """Find where the stereo head stands, and write it into DIR/stereo_bridge.yaml.

    From SESSION (CSV or bag), measured with the hand_eye that stands in the file now (the same
    session may be given again: what stood there before is in measured.yaml); or live:
    move the arm to one pose after the other and let it rest. The arm's own errors go into the
    residual: with a calibrated --model it is smaller. DIR/simulated_arm.yaml follows.

    \b
    Examples:
      longarm stereo hand-eye my_arm my_arm/session --model my_arm/model.yaml
      longarm stereo hand-eye my_arm --live --poses 20
    """
    from longarm_comp.arm_folder.head_file import head_at, write_head
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.jobs.camera_placement import placed_cameras
    from longarm_comp.sessions.read import read_session
    from longarm_comp.workflows.inputs import physics

    if (session is not None) == live:
        given = "both" if live else "neither"
        raise InputError("stereo hand-eye", "SESSION, --live", given, "one of the two")
    arm = Arm.load(folder / "arm.yaml")
    known = physics(arm, model)
    if session is not None:
        rows = read_session(session, arm)
    else:
        rows = _live(arm, poses, within, namespace)
    assumed = head_at(folder, rows.hash)
    found = placed_cameras(known, rows, assumed, free_tip)
    written = [] if dry_run else write_head(folder, found.pose, assumed, rows.hash, _quality(found))
    if as_json:
        print_json({"files": written, "xyz": found.pose[:3, 3], "quaternion": found.quaternion,
                    **_quality(found), "tip_off_mm": found.tip_off_mm})  # fmt: skip
    else:
        _show(found)
    if written:
        note(
            f"{' and '.join(written)} written: a running graph reads them when it is started again"
        )
    if arm.camera is not None and written:
        off = float(sum((a - b) ** 2 for a, b in zip(arm.camera.position_m, found.pose[:3, 3],
                                                     strict=True)) ** 0.5)  # fmt: skip
        if off > 0.01:
            note(f"arm.yaml has its camera {1e3 * off:.0f} mm from there: put position_m and "
                 "optical_axis right before the next calibration")  # fmt: skip


def _live(arm: Arm, poses: int, within: float, namespace: str) -> Session:
    from longarm_comp.cli.signals import stop_on_signals
    from longarm_comp.jobs.rest_sightings import sightings_at_rest

    with stop_on_signals() as stop:
        return sightings_at_rest(arm, poses, within, note, namespace=namespace, stop=stop)


def _quality(found: HeadPlacement) -> dict[str, object]:
    return {
        "rows": found.rows,
        "outliers": found.outliers,
        "position_sd_mm": [round(float(v), 3) for v in found.position_sd_mm],
        "rotation_sd_deg": [round(float(v), 4) for v in found.rotation_sd_deg],
        "residual_mm": round(found.residual_mm, 3),
        "held_out_mm": round(found.held_out_mm, 3),
    }


def _show(found: HeadPlacement) -> None:
    rows = [
        (f"{axis}, m", f"{value:.4f}", f"{sd:.2f} mm")
        for axis, value, sd in zip("xyz", found.pose[:3, 3], found.position_sd_mm, strict=True)
    ]
    rows += [
        (f"q{axis}", f"{value:.5f}", f"{sd:.3f} deg" if sd is not None else "")
        for axis, value, sd in zip(
            "xyzw", found.quaternion, [*found.rotation_sd_deg, None], strict=True
        )
    ]
    print_table("Left camera in the base frame", ("", "value", "1 sigma"), rows)
    note(f"{found.rows} rows, {found.outliers} left out as outliers; residual "
         f"{found.residual_mm:.2f} mm, on rows held out {found.held_out_mm:.2f} mm")  # fmt: skip
    note(f"it was assumed {found.moved_mm:.1f} mm and {found.turned_deg:.2f} deg from there")
    if found.tip_off_mm is not None:
        off = ", ".join(f"{v:.2f}" for v in found.tip_off_mm)
        note(f"the seen point is at ({off}) mm from the declared tip, in the tip frame: "
             "correct tip_in_marker or the tip of arm.yaml")  # fmt: skip
