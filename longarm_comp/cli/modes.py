"""``longarm modes``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from longarm_comp.cli import options
from longarm_comp.cli.output import note, print_json, print_rows


@click.command()
@options.arm
@options.path_option(
    "--at", "Poses (poses.csv); default: both ends and the middle of the joints' ranges."
)
@options.model
@click.option("--move", default=0.5, help="Time of a move, s.")
@click.option(
    "--damping",
    type=float,
    metavar="SHARE",
    help="Share of critical damping; default: that of arm.yaml, else 0.01.",
)
@options.path_option(
    "--ring",
    "After a move to the first pose: CSV with t_s and x,y,z, or read_q1..qn; or a bag, after its "
    "last command.",
)
@options.effects
@options.as_json
def command(
    arm: options.Arm,
    at: Path | None,
    model: Path | None,
    move: float,
    damping: float | None,
    ring: Path | None,
) -> None:
    """Predict how ARM rings: its slowest modes, and the time until the tip is still after a move.

    The stiffness is that of the model, with the drives held. settle_s is the time until the tip
    stays within 0.1 mm, after a straight move of --move seconds from the pose before. With --ring
    the measured frequencies and damping are printed too, and the computed modes are corrected by
    them. If it is a bag, the pose of its last command comes first.

    \b
    Examples:
      longarm modes arm.yaml
      longarm modes arm.yaml --model model.yaml --at poses.csv --ring tip.csv
    """
    from longarm_comp.core.vibration.ring import USUAL_DAMPING, ring_of_moves
    from longarm_comp.core.vibration.seen import (
        SeenWave,
        as_tips,
        correct_modes,
        find_least_steps,
        fit_waves,
    )
    from longarm_comp.sessions.poses import read_poses
    from longarm_comp.sessions.read import read_ring
    from longarm_comp.workflows.inputs import choose_physics

    known = choose_physics(arm, model)
    ends = np.stack([arm.lower, arm.mid, arm.upper])
    joints = ends if at is None else read_poses(at, arm).q
    chosen = damping if damping is not None else arm.damping or USUAL_DAMPING
    heard = None if ring is None else read_ring(ring, arm)
    if heard is not None and heard.at is not None:
        joints = np.vstack([heard.at, joints])
    found = ring_of_moves(known, joints, move, chosen)
    seen: list[SeenWave] = []
    if heard is not None:
        seen, here = fit_waves(heard.times, heard.seen), found[0][0]
        tips = as_tips(seen, here) if heard.of_joints and len(here.omega) else seen
        found = [(correct_modes(each, here, tips), left) for each, left in found]
        if not seen:
            note(f"{ring}: nothing rings above the noise")
        if heard.of_joints:
            smallest = find_least_steps(heard.seen)
            largest = np.max([w.size for w in seen] or np.zeros((1, 1)), axis=0)
            if (largest <= smallest).all():
                listed = " ".join(f"{value:.2g}" for value in smallest.tolist())
                note(f"no joint rings by more than one step of its encoder, {listed} rad or m")
            note("an encoder sees only what bends before it: at a motor it hardly sees a beam ring")
    rows: list[dict[str, Any]] = []
    for row, (each, left) in enumerate(found):
        ways = each.tip / np.maximum(np.linalg.norm(each.tip, axis=1, keepdims=True), 1e-30)
        rows += [
            {
                "posture": row,
                "mode": k + 1,
                "hz": float(hz),
                **{f"tip_{axis}": float(part) for axis, part in zip("xyz", way, strict=True)},
                "ring_mm": 1e3 * left.size_m(),
                "settle_s": left.settle_s(),
            }
            for k, (hz, way) in enumerate(zip(each.hz, ways, strict=True))
        ]
    size = "size_rad_m" if heard is not None and heard.of_joints else "size_mm"
    scale = 1e3 if size == "size_mm" else 1.0
    names = ("hz", "hz_sd", "damping", "damping_sd")
    told = [
        {name: getattr(w, name) for name in names} | {size: (scale * w.size).tolist()} for w in seen
    ]
    print_json({"damping": chosen, "rows": rows, "seen": told})
    if not rows:
        note("nothing of this model bends under load: declare beams, or give --model")
        return
    print_rows(f"Modes of {arm.name}, damping {chosen:g}", rows)
    print_rows("Seen after a move", told)
    if damping is None and arm.damping is None and not seen:
        note("the damping is assumed: measure it (--ring) and write `damping` into arm.yaml")
