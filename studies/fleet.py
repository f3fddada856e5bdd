"""Many simulated arms of one kind through `longarm fleet`: what is found, and what it takes.

Every arm has errors of geometry of its own, the kind's soft joints, and some have play besides: in
so much the true arm, by other physics, differs from the drawing that all share.
"""

import resource
import time
from pathlib import Path

import click
import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.files import write_text
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.catalogue import draw
from longarm_comp.workflows.fleet import Diagnosed, fleet
from studies.commands import Figures, Show, study_command, whole_number

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "panda_touch"
ROWS = 80
"""Poses an arm: twice its parameters of geometry."""
SIGMA_M = 1e-4
OF_KIND, OWN, EACH = "joint_compliance", "backlash", 4
"""What all arms have, and what one in so many has besides."""
GEOMETRY = ("joint_zero", "dh_error")
SIZES_MM = {OF_KIND: 2.0, OWN: 1.0, **dict.fromkeys(GEOMETRY, 3.0)}


def write_arms(folder: Path, count: int, seed: int) -> None:
    """One arm.yaml, and a session of each of `count` arms."""
    folder.mkdir(parents=True, exist_ok=True)
    text = (EXAMPLE / "arm.yaml").read_text(encoding="utf-8")
    write_text(folder / "arm.yaml", text)
    arm = Arm.load(folder / "arm.yaml")
    soft = draw(OF_KIND, arm, np.random.default_rng(seed), SIZES_MM[OF_KIND])
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        hidden = [soft, *(draw(name, arm, rng, SIZES_MM[name]) for name in GEOMETRY)]
        if number % EACH == 0:
            hidden.append(draw(OWN, arm, rng, SIZES_MM[OWN]))
        q = arm.lower + (arm.upper - arm.lower) * rng.random((ROWS, arm.n))
        side = rng.choice([-1.0, 1.0], q.shape)
        tip = TrueArm(arm, tuple(hidden)).pose(q, TrueContext(side))[:, :3, 3]  # type: ignore
        rows = Session.record(
            q, tip + SIGMA_M * rng.standard_normal(tip.shape), approach=side, source="simulated"
        )
        write_csv(rows, folder / f"arm_{number:04d}.csv")


def row(arms: list[Diagnosed]) -> dict[str, object]:
    """Return shares of arms where what is hidden was found, and something else."""

    def share(name: str, among: list[Diagnosed]) -> float:
        found = [any(name in f.effect for f in arm.findings) for arm in among]
        return round(float(np.mean(found)), 3) if found else 0.0

    own = [arm for k, arm in enumerate(arms) if k % EACH == 0]
    told = {f"{f.effect} at {f.where}" for arm in arms for f in arm.findings if f.of_kind}
    held = {OF_KIND, OWN}
    false = [any(held.isdisjoint(f.effect.split(" or ")) for f in arm.findings) for arm in arms]
    left = [arm.diagnosed_mm for arm in arms if arm.diagnosed_mm is not None]
    before = [arm.calibrated_mm for arm in arms if arm.calibrated_mm is not None]
    return {
        "arms": len(arms),
        "failed": sum(arm.verdict == "failed" for arm in arms),
        "kind_found": share(OF_KIND, arms),
        "own_found": share(OWN, own),
        "another_name": round(float(np.mean(false)), 3),
        "of_kind": sorted(told),
        "calibrated_mm": round(float(np.mean(before)), 3),
        "diagnosed_mm": round(float(np.mean(left)), 3),
    }


@study_command(
    click.option(
        *("--arms", "counts"), type=click.IntRange(min=1), multiple=True, default=(20, 200),
        show_default=True, help="Simulated arms; a larger number goes on after the smaller.",
    ),
    options.output(
        "build/fleet",
        "Folder for arms and diagnoses; existing results are continued.",
        outputs.left_to_the_command,
    ),
    whole_number("--jobs", 1, "Processes."),
    options.dask,
    options.seed,
)  # fmt: skip
def command(
    counts: tuple[int, ...], output: Path, jobs: int, dask: str | None, seed: int, show: Show
) -> Figures:
    """Simulated arms of one kind diagnosed by `longarm fleet`; its time and peaks of memory.

    A peak is of this process, and of the largest that it started and that has ended.

    \b
    Example:
      longarm study fleet --arms 20 --arms 200
      longarm study fleet --arms 8 --arms 16 --dask local --jobs 2
    """
    rows = []
    for count in sorted(counts):
        write_arms(output / "arms", count, seed)
        begun = time.monotonic()
        arms = fleet(
            output / "arms", output / "out", jobs=jobs, dask=dask, network=False, progress=show
        )
        took = round(time.monotonic() - begun, 1)
        own, workers = (
            round(resource.getrusage(whose).ru_maxrss / 1024.0)
            for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        )
        memory = {"peak_mb": own, "worker_mb": workers if jobs > 1 or dask else None}
        rows.append(row(arms) | {"time_s": took} | memory)
    return Figures({"seed": seed, "fleets": rows}, {"Fleets of simulated arms of one kind": rows})
