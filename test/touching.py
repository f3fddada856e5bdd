"""An arm with a ball at its hand that touches sockets and a table; its errors are hidden."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import geometry
from longarm_comp.sim.hidden.base import HiddenEffect

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "panda_touch"
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


def errors_of_the_drawing(seed: int = 4, scale: float = 1.0) -> tuple[HiddenEffect, ...]:
    """Zeros and DH errors, as large as a Panda's."""
    rng = np.random.default_rng(seed)
    delta = np.array([[1e-3], [5e-3], [1e-3], [0.0]]) * rng.standard_normal((4, ARM.n))
    zeros = 5e-3 * rng.standard_normal(ARM.n)
    return geometry.DhError(scale * delta), geometry.JointZero(scale * zeros)


def joints_at(
    hidden: Sequence[HiddenEffect], points: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(N, n) joints within the limits at which the true tip is at points (N, 3), m."""
    true, drawn, room = TrueArm(ARM, hidden), Model(ARM), ARM.upper - ARM.lower

    def towards(q: np.ndarray, away: np.ndarray) -> np.ndarray:
        steps = 1e-5 * np.eye(ARM.n)
        columns = np.stack([(drawn.tip(q + e) - drawn.tip(q - e)) / 2e-5 for e in steps], axis=2)
        return q + np.clip(
            (np.linalg.pinv(columns, rcond=1e-2) @ away[..., None])[..., 0], -0.3, 0.3
        )

    found = np.full((len(points), ARM.n), np.nan)
    while np.isnan(found).any():
        left = np.flatnonzero(np.isnan(found[:, 0]))
        q = ARM.lower + room * (0.1 + 0.8 * rng.random((len(left), ARM.n)))
        for _ in range(30):
            q = towards(q, points[left] - drawn.tip(q))
        for _ in range(5):
            away = points[left] - true.pose(q)[:, :3, 3]
            q = towards(q, away)
        there = np.linalg.norm(away, axis=1) < 1e-6
        inside = ((q > ARM.lower) & (q < ARM.upper)).all(axis=1)
        found[left[there & inside]] = q[there & inside]
    return found


def touching(
    hidden: Sequence[HiddenEffect],
    rows: int,
    *,
    sockets: Mapping[str, np.ndarray] = SOCKETS,
    sigma: float = SIGMA,
    seed: int = 1,
    distances: Sequence[tuple[str, str, float, float]] = DISTANCES,
) -> Session:
    """Rows that touch each socket in turn."""
    rng = np.random.default_rng(seed)
    names = np.array([list(sockets)[k % len(sockets)] for k in range(rows)])
    points = np.array([sockets[name] for name in names])
    q = joints_at(hidden, points + sigma * rng.standard_normal(points.shape), rng)
    nowhere = np.full((rows, 3), np.nan)
    return Session.record(q, nowhere, labels={"touch": names}, touch_distances=distances)


def miss(model: Model, hidden: Sequence[HiddenEffect]) -> float:
    """Mean error (m) of the tip at fresh poses, wherever the arm is said to stand."""
    q = np.random.default_rng(99).uniform(ARM.lower, ARM.upper, (300, ARM.n))
    true, said = TrueArm(ARM, hidden).pose(q)[:, :3, 3], model.tip(q)
    middle, mean = said.mean(axis=0), true.mean(axis=0)
    u, _, vt = np.linalg.svd((said - middle).T @ (true - mean))
    turn = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return float(np.linalg.norm((said - middle) @ turn.T - (true - mean), axis=1).mean())
