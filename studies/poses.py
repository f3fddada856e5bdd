"""Which poses to measure: error of the true tip by grid, Sobol and I-optimal poses.

Where the effect has to be found, the whole diagnosis is run, which holds back some of the poses.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.plan import Plan, grid, random_joints, sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.planning.optimal_poses import Uncertainty, choose_optimal_poses
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.catalogue import hidden
from studies.commands import Figures, Show, arm_option, arms_option, study_command

COUNTS = (40, 60, 100, 200)
SIGMA_M = 3e-4
"""Noise of a coordinate."""
FRESH = 300
"""Poses that are never measured."""
WAYS = ("grid", "sobol", "i-optimal")
HIDDEN = ("joint_zero", "dh_error", "base_pose", "joint_compliance")
"""What the true arm hides; the last is the effect that is known, or to be found."""


@dataclass(frozen=True)
class PoseOutcome:
    """Mean error (m) of the true tip at fresh poses.

    Attributes:
        way: how the poses were chosen.
        n: how many.
        known: whether the calibration was told the hidden effect.
        error: m.
        expected: rms error that the plan had expected, m; NaN of other plans.
    """

    way: str
    n: int
    known: bool
    error: float
    expected: float


def plan_poses(arm: Arm, way: str, n: int, known: bool, seed: int) -> Plan:
    """Return the poses of one way; only I-optimal ones depend on what is known."""
    if way == "grid":
        return grid(arm, n, seed)
    if way == "sobol":
        return sobol(arm, n, seed)
    model = declared_model(arm)
    if known:
        model = model.plus(*JointCompliance.for_arm(arm))
    uncertain = Uncertainty.of(model, None, "position", known=known, sigma=(SIGMA_M, 1e-3))
    return choose_optimal_poses(uncertain, n, rng=seed)


def one_arm(
    arm: Arm, seed: int, counts: Sequence[int] = COUNTS, ways: Sequence[str] = WAYS
) -> Iterator[PoseOutcome]:
    """Yield every way and count on one true arm, with the effect known and to be found."""
    rng = np.random.default_rng([seed, 5])
    true = TrueArm(arm, [hidden(name, arm, 1.0, rng) for name in HIDDEN])
    fresh = random_joints(arm, FRESH, rng)
    where = true.tip(fresh, TrueContext())
    for n in counts:
        for known in (True, False):
            for way in ways:
                plan = plan_poses(arm, way, n, known, seed)
                noise = np.random.default_rng([seed, n, 7])
                xyz = true.tip(plan.q, TrueContext())
                xyz = xyz + SIGMA_M * noise.standard_normal(xyz.shape)
                session = Session.record(plan.q, xyz, approach=plan.approach, source=way)
                if known:
                    base = dict(fit_stages(declared_model(arm), session))["geometry"].model
                    model = fit_model(base.plus(*JointCompliance.for_arm(arm)), session).model
                else:
                    model = diagnose(arm, session).model
                error = np.linalg.norm(model.tip(fresh) - where, axis=1).mean()
                expected = float(getattr(plan, "expected_m", np.nan))
                yield PoseOutcome(way, n, known, float(error), expected)


def table(found: Sequence[PoseOutcome]) -> list[dict[str, Any]]:
    """List the arms' mean error in mm: a row a count, known and to be found; a column a way."""
    rows = []
    for known in (True, False):
        for n in sorted({one.n for one in found}):
            row: dict[str, Any] = {"effect": "known" if known else "to be found", "poses": n}
            for way in dict.fromkeys(one.way for one in found):
                errors = [o.error for o in found if (o.n, o.known, o.way) == (n, known, way)]
                row[f"{way}_mm"] = round(1e3 * float(np.mean(errors)), 3)
            rows.append(row)
    return rows


@study_command(arm_option, arms_option(3), options.seed)
def command(arm: Arm, arms: int, seed: int, show: Show) -> Figures:
    """Error of the true tip after 40, 60, 100, 200 poses by grid, Sobol and I-optimal choice.

    The arms have hidden geometry errors and soft joints, which the calibration knows or has to
    find. Each arm takes a few minutes.

    \b
    Example:
      longarm study poses --arms 3
    """
    found: list[PoseOutcome] = []
    steps = arms * len(COUNTS) * len(WAYS) * 2
    for k in range(seed, seed + arms):
        for one in one_arm(arm, k):
            found.append(one)
            show(f"{one.n} poses by {one.way}", len(found) / steps)
    rows = table(found)
    return Figures(
        {"arms": arms, "seed": seed, "rows": rows, "runs": [vars(o) for o in found]},
        {f"Error of the true tip, mean of {arms} arms": rows},
    )
