"""Calibration files of the two cameras in an arm's folder."""

from __future__ import annotations

from pathlib import Path

from longarm_comp.arm_folder.measured import note_measured
from longarm_comp.devices.stereo.calibrate import BoardCalibration
from longarm_comp.devices.stereo.camera_file import calibration_of, write_camera

CAMERAS = "cameras"
SIDES = ("left", "right")


def camera_path(folder: Path, side: str) -> Path:
    """File of the left or the right camera."""
    return folder / CAMERAS / f"{side}.yaml"


def write_cameras(folder: Path, found: BoardCalibration) -> list[Path]:
    """Write both files and what was measured; returns their paths."""
    cameras = dict(zip(SIDES, calibration_of(found.fit.rig), strict=True))
    head = (
        f"Calibrated from {len(found.fit.used)} views, {found.fit.rms_px:.3f} px rms; boards that "
        f"were left out:\n{found.held_out_mm:.3f} mm rms at {found.distances_m[0]:.2f} to "
        f"{found.distances_m[1]:.2f} m. Both files belong together."
    )
    for side, camera in cameras.items():
        write_camera(camera_path(folder, side), side, camera, head)
    facts = {
        "views": len(found.fit.used),
        "rms_px": round(found.fit.rms_px, 4),
        "held_out_mm": round(found.held_out_mm, 4),
    }
    note_measured(folder, CAMERAS, "stereo calibrate", facts)
    return [camera_path(folder, side) for side in SIDES]
