"""``python -m bench.stereo``: accuracy of the measured tip, by marker and depth.

Rendered pairs with known truth; the marker is turned and moved at random over the common view.
``bias`` and ``sd`` are of measured - true in the left optical frame (x right, y down, z forward);
``sigma`` is what the covariance says; ``nees`` is the mean squared normalised error over its
expectation of 3 (1 = honest, below 1 = cautious).
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import click
import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from longarm_comp.devices.stereo.camera import StereoRig
from longarm_comp.devices.stereo.eye import StereoEye
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard, Target
from longarm_comp.sim.cameras import CameraPair, Conditions, Plate, charuco_plate, render, tag_plate

APRIL = "DICT_APRILTAG_36h11"
MARKERS: dict[str, tuple[Target, Plate]] = {
    "ArUco 4x4, 60 mm": (TagBoard(0.06), tag_plate(0.06)),
    "2x2 ArUco 4x4, 40 mm": (TagBoard(0.04, 0.01, 2, 2), tag_plate(0.04, 0.01, 2, 2)),
    "AprilTag 36h11, 80 mm": (TagBoard(0.08, dictionary=APRIL), tag_plate(0.08, dictionary=APRIL)),
    "ChArUco 5x5, 40 mm": (CharucoTarget(0.04, 0.028, 5, 5), charuco_plate(0.04, 0.028, 5, 5)),
}
DEPTHS_M = (0.8, 1.2, 1.7, 2.2, 2.8)


@dataclass(frozen=True)
class StereoRow:
    """One line of the table: x, y, z in the left optical frame; None where nothing was measured."""

    marker: str
    depth_m: float
    pairs: int
    measured: int
    refused: dict[str, int]
    bias_mm: list[float] | None
    sd_mm: list[float] | None
    sigma_mm: list[float] | None
    error_rms_mm: float | None
    error_p95_mm: float | None
    nees: float | None
    cpu_ms: float | None


def random_pose(cameras: CameraPair, depth_m: float, rng: np.random.Generator) -> np.ndarray:
    """Marker (4, 4) in the base, up to 0.4 rad askew about each axis, inside both images."""
    shown = cameras.size[0] / (2 * cameras.focal_px) * 0.85
    left = min(max(cameras.baseline_m / depth_m - shown, -shown), shown)
    camera_T_marker = np.eye(4)
    turn = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
    camera_T_marker[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
    across, down = rng.uniform(left, shown), rng.uniform(-0.2, 0.2)
    camera_T_marker[:3, 3] = depth_m * np.array([across, down, 1.0])
    return cameras.left_in_base @ camera_T_marker


def measure_rows(
    cameras: CameraPair, conditions: Conditions, pairs: int, seed: int
) -> Iterator[StereoRow]:
    """The table, a row at a time."""
    camera_R_base = cameras.camera_in_base[:3, :3].T
    rig = StereoRig.from_camera_info(*cameras.camera_infos(), rectified=False)
    for name, (target, plate) in MARKERS.items():
        for depth in DEPTHS_M:
            rng = np.random.default_rng(seed)
            eye = StereoEye(rig, target, cameras.camera_in_base)
            errors, sigmas, normalised, spent = [], [], [], []
            refused: Counter[RefusalReason] = Counter()
            for number in range(pairs):
                truth = random_pose(cameras, depth, rng)
                now = replace(conditions, background=2 * (number % 3))
                images = render(truth, plate, cameras, rng, now)
                started = time.process_time()
                try:
                    seen = eye.measure(*images)
                except StereoRefusal as refusal:
                    refused[refusal.reason] += 1
                    continue
                spent.append(time.process_time() - started)
                error = seen.point - truth[:3, 3]
                errors.append(camera_R_base @ error)
                covariance = seen.pose_covariance[:3, :3]
                sigmas.append(np.sqrt(np.diag(camera_R_base @ covariance @ camera_R_base.T)))
                normalised.append(error @ np.linalg.solve(covariance, error) / 3)
            yield _row(name, depth, pairs, refused, errors, sigmas, normalised, spent)


def _row(
    name: str,
    depth: float,
    pairs: int,
    refusals: Counter[RefusalReason],
    errors: list[np.ndarray],
    sigmas: list[np.ndarray],
    normalised: list[float],
    spent: list[float],
) -> StereoRow:
    refused = {reason.name.lower(): count for reason, count in refusals.items()}
    if not errors:
        return StereoRow(name, depth, pairs, 0, refused, *[None] * 7)
    error = 1e3 * np.array(errors)
    length = np.linalg.norm(error, axis=1)
    return StereoRow(
        marker=name,
        depth_m=depth,
        pairs=pairs,
        measured=len(error),
        refused=refused,
        bias_mm=error.mean(axis=0).tolist(),
        sd_mm=error.std(axis=0).tolist(),
        sigma_mm=(1e3 * np.mean(sigmas, axis=0)).tolist(),
        error_rms_mm=float(np.sqrt(np.mean(length**2))),
        error_p95_mm=float(np.percentile(length, 95)),
        nees=float(np.mean(normalised)),
        cpu_ms=1e3 * float(np.median(spent)),
    )


def _table(rows: list[StereoRow], cameras: CameraPair) -> Table:
    width, height = cameras.size
    title = (
        f"Stereo: 2 x {width}x{height}, f {cameras.focal_px:g} px, "
        f"baseline {cameras.baseline_m * 1e3:g} mm; all lengths in mm, x y z"
    )
    table = Table("marker", "depth_m", "seen", title=title)
    for heading in ("bias", "sd", "sigma", "3-D rms", "3-D p95", "nees", "cpu ms"):
        table.add_column(heading, justify="right")
    for row in rows:
        triples = (
            "-" if v is None else " ".join(f"{x:.3f}" for x in v)
            for v in (row.bias_mm, row.sd_mm, row.sigma_mm)
        )
        numbers = ((row.error_rms_mm, 3), (row.error_p95_mm, 3), (row.nees, 2), (row.cpu_ms, 1))
        table.add_row(
            row.marker,
            f"{row.depth_m:g}",
            f"{row.measured}/{row.pairs}",
            *triples,
            *("-" if x is None else f"{x:.{digits}f}" for x, digits in numbers),
        )
    return table


@click.command()
@click.option("--pairs", default=60, show_default=True, type=click.IntRange(2))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--baseline", default=0.3, show_default=True, type=click.FloatRange(0.01), help="m")
@click.option("--focal", default=800.0, show_default=True, type=click.FloatRange(50.0), help="px")
@click.option("--blur", default=0.6, show_default=True, type=click.FloatRange(0.0), help="px")
@click.option("--noise", default=1.5, show_default=True, type=click.FloatRange(0.0), help="grey")
@click.option("--json", "as_json", is_flag=True, help="Rows as JSON.")
def main(
    pairs: int, seed: int, baseline: float, focal: float, blur: float, noise: float, as_json: bool
) -> None:
    """3-D error and sigma of the stereo measurement against depth, in mm."""
    cv2.setNumThreads(1)
    cameras = CameraPair(baseline_m=baseline, focal_px=focal)
    conditions = Conditions(blur_px=blur, read_noise=noise)
    rows = list(
        track(
            measure_rows(cameras, conditions, pairs, seed),
            total=len(MARKERS) * len(DEPTHS_M),
            description="stereo",
            disable=as_json,
            transient=True,
        )
    )
    if as_json:
        click.echo(json.dumps([asdict(row) for row in rows]))
    else:
        Console(width=150).print(_table(rows, cameras))


if __name__ == "__main__":
    main()
