"""``longarm plan``."""

from pathlib import Path
from typing import Any

import click
import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.cli.output import note, print_json
from longarm_comp.core.errors import InputError


@click.command()
@options.arm_file
@options.choice(
    "--kind",
    ["grid", "sobol", "next", "i-optimal", "d-optimal"],
    required=True,
    what="grid: as in the paper; sobol: fills the ranges evenly; next: as a diagnosis asks; "
    "i-optimal: least expected error of the tip; d-optimal: all parameters known best.",
)
@click.option("-n", "count", type=int, required=True, help="How many poses.")
@options.path_option("--report", "Folder of a diagnosis (for next, i-optimal, d-optimal).")
@options.path_option(
    "--model", "Calibrated model; the arm is assumed to have its effects and no others."
)
@options.path_option("--measured", "Rows measured so far (CSV or bag).")
@options.choice(
    "--measure",
    ["position", "pose", "distance", "touch"],
    default="position",
    what="What is measured at each pose; distance: to every anchor in arm.yaml; touch: a --point.",
)
@click.option(
    "--point",
    "points",
    type=(str, float, float, float),
    multiple=True,
    metavar="NAME X Y Z",
    help="A point to touch, and roughly where it is (m, base frame); repeat for more.",
)
@click.option(
    "--noise-mm",
    type=click.FloatRange(min=1e-6, max=1e3),  # a nanometre to a metre
    default=0.3,
    help="Noise of a measured length, if no rows are given.",
)
@options.floor
@options.flag("--seen", "Only poses at which the cameras of ARM's folder see the marker.")
@options.output("poses.csv", "Plan to write.", outputs.POSES)
@options.like
@options.seed
@options.as_json
def command(
    arm: Path,
    kind: str,
    count: int,
    measure: str,
    points: tuple[tuple[str, float, float, float], ...],
    noise_mm: float,
    seen: bool,
    output: Path,
    like: Path | None,
    **given: Any,
) -> None:
    """Write N poses at which to measure ARM, with the side from which every joint arrives.

    \b
    Examples:
      longarm plan arm.yaml --kind grid -n 300 -o poses.csv
      longarm plan arm.yaml --kind sobol -n 60 --seen --floor -0.02 -o poses.csv
      longarm plan arm.yaml --kind next -n 20 --report diagnosis -o poses.csv
      longarm plan arm.yaml --kind i-optimal -n 60 -o poses.csv
    """
    from longarm_comp.core.arm.arm import Arm
    from longarm_comp.core.planning.optimal_poses import OptimalPlan
    from longarm_comp.sessions.poses import write_poses
    from longarm_comp.workflows.plan import NOISE, plan

    declared = Arm.load(arm)
    form, output = options.form_of(like, output)
    given |= {"kind": kind, "measure": measure, "noise": (1e-3 * noise_mm, NOISE[1])}
    given |= {"points": {name: place for name, *place in points}}
    if seen:
        from longarm_comp.arm_folder.head import view_beside

        view = view_beside(arm)
        if view is None:
            files = "stereo_bridge.yaml and simulated_arm.yaml beside ARM"
            raise InputError("plan", "--seen", "no cameras", f"{files} (longarm init writes them)")
        given["seen"] = lambda tips: np.array([not why for why in view.unseen(tips)])
    poses = plan(declared, count, note=note, **given)
    write_poses(poses, output, *([form.write] if form else []))
    facts: dict[str, Any] = {"output": output, "poses": poses.q, "approach": poses.approach}
    note(f"{len(poses)} poses in {output}")
    if isinstance(poses, OptimalPlan):
        facts["expected_mm"] = 1e3 * poses.expected_m
        facts["expected_with_20_more_mm"] = 1e3 * poses.ahead_m
        note(poses.stop_rule)
    print_json(facts)
