"""An arm with a ball at its hand that touches sockets and a table; its errors are hidden."""

from collections.abc import Mapping, Sequence

import numpy as np
from places import EXAMPLES

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import kabsch
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import geometry
from longarm_comp.sim.hidden.base import HiddenEffect
from studies.measurements import joints_at

EXAMPLE = EXAMPLES / "panda_touch"
ARM = Arm.load(EXAMPLE / "arm.yaml")
SIGMA = 1e-4
GAP = 0.05
"""Distance of the two sockets of a tool, m."""
PLACES = {"front": (0.5, 0.1, 0.1), "left": (0.1, 0.55, 0.2), "high": (0.35, -0.3, 0.5)}
WAYS = {"front": (1.0, 0.0, 0.0), "left": (0.0, 0.6, -0.8), "high": (-0.6, 0.8, 0.0)}
"""From a tool's first socket to its second."""
SOCKETS = {
    f"{name}_{k}": np.array(PLACES[name]) + k * GAP * np.array(WAYS[name])
    for name in PLACES
    for k in (0, 1)
}
DISTANCES = tuple((f"{name}_0", f"{name}_1", GAP, 1e-5) for name in PLACES)


def errors_of_the_drawing() -> tuple[HiddenEffect, ...]:
    """Zeros and DH errors, as large as a Panda's."""
    rng = np.random.default_rng(4)
    delta = np.array([[1e-3], [5e-3], [1e-3], [0.0]]) * rng.standard_normal((4, ARM.n))
    zeros = 5e-3 * rng.standard_normal(ARM.n)
    return geometry.DhError(delta), geometry.JointZero(zeros)


def touching(
    hidden: Sequence[HiddenEffect],
    rows: int,
    *,
    sockets: Mapping[str, np.ndarray] = SOCKETS,
    seed: int = 1,
    distances: Sequence[tuple[str, str, float, float]] = DISTANCES,
) -> Session:
    """Rows that touch each socket in turn."""
    rng = np.random.default_rng(seed)
    names = np.array([list(sockets)[k % len(sockets)] for k in range(rows)])
    points = np.array([sockets[name] for name in names])
    true = TrueArm(ARM, hidden)
    q = joints_at(ARM, true, points + SIGMA * rng.standard_normal(points.shape), rng)
    nowhere = np.full((rows, 3), np.nan)
    return Session.record(q, nowhere, labels={"touch": names}, touch_distances=distances)


def miss(model: Model, hidden: Sequence[HiddenEffect]) -> float:
    """Mean error (m) of the tip at fresh poses, wherever the arm is said to stand."""
    q = np.random.default_rng(99).uniform(ARM.lower, ARM.upper, (300, ARM.n))
    true, said = TrueArm(ARM, hidden).pose(q)[:, :3, 3], model.tip(q)
    turn, shift = kabsch(said, true, np.ones(len(q)))
    return float(np.linalg.norm(said @ turn.T + shift - true, axis=1).mean())
