"""A heavy four-joint arm whose motors are read: droop before the encoders, softness behind them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from studies.simulated import TrueEncoders

SIGMA = 2e-4
ENCODERS = TrueEncoders(step=1e-4, zero=np.array([2e-3, -1e-3, 5e-4, 0.0]), scale=1e-3)


def heavy(**of_joints: object) -> Arm:
    """The arm, with further keys in every joint's row."""
    rows = (
        {"d_m": 0.1, "limits_deg": [-40, 40]},
        {"alpha_deg": 90, "limits_deg": [-20, 60]},
        {"a_m": 0.35, "limits_deg": [-70, 10]},
        {"a_m": 0.3, "limits_deg": [-60, 60]},
    )
    data = {
        "name": "heavy",
        "convention": "mdh_craig",
        "tip": {"frame": 4, "position_m": [0.2, 0.03, 0.02]},
        "joints": [
            {"id": k, "type": "revolute", **row, **of_joints} for k, row in enumerate(rows, 1)
        ],
        "point_masses": [
            {"name": "elbow", "frame": 3, "mass_kg": 0.3},
            {"name": "tool", "frame": 4, "position_m": [0.2, 0.0, 0.0], "mass_kg": 0.8},
        ],
    }
    return Arm.parse(data, "heavy arm")


ARM = heavy()


def readings(values: np.ndarray) -> dict[str, np.ndarray]:
    """(N, n) as a session has them."""
    return {f"read_q{k + 1}": values[:, k : k + 1] for k in range(values.shape[1])}


@dataclass(frozen=True)
class Sensed:
    """Rows of the true arm: commands and readings (N, n), side of arrival (N,), tip (N, 3) m."""

    q: np.ndarray
    side: np.ndarray
    read: np.ndarray
    tip: np.ndarray


def sensed(hidden: Sequence[HiddenEffect] = (), n: int = 120, seed: int = 1) -> Sensed:
    """Random poses of the arm as it really stands, each from a random side."""
    rng = np.random.default_rng(seed)
    q = ARM.lower + rng.random((n, ARM.n)) * (ARM.upper - ARM.lower)
    side = rng.choice([-1.0, 1.0], n)
    true, context = TrueArm(ARM, hidden), TrueContext(approach=np.repeat(side[:, None], ARM.n, 1))
    return Sensed(q, side, ENCODERS.read(true.shafts(q, context), rng), true.tip(q, context))


def session(
    hidden: Sequence[HiddenEffect] = (), n: int = 120, seed: int = 1, encoders: bool = True
) -> Session:
    """The same, measured to 0.2 mm an axis."""
    rows = sensed(hidden, n, seed)
    xyz = rows.tip + SIGMA * np.random.default_rng(seed + 1).standard_normal((n, 3))
    told = readings(rows.read) if encoders else None
    return Session.record(rows.q, xyz, approach=rows.side, readings=told)
