"""The small arm as it really stands, with hidden effects, measured as a session."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from small_arm import ARM

from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.base import HiddenEffect

Draw = Callable[[np.random.Generator, int], np.ndarray]
SIGMA = 2e-4


def white(rng: np.random.Generator, n: int) -> np.ndarray:
    """Independent noise (n, 3), m."""
    return SIGMA * rng.standard_normal((n, 3))


def session(
    hidden: Sequence[HiddenEffect] = (),
    n: int = 120,
    seed: int = 1,
    levels: int = 0,
    noise: Draw = white,
    directions: bool = True,
) -> Session:
    """Random poses (of so many levels per joint, if given), each from a random side."""
    rng = np.random.default_rng(seed)
    share = rng.integers(levels, size=(n, ARM.n)) / (levels - 1) if levels else rng.random((n, 4))
    q = ARM.lower + share * (ARM.upper - ARM.lower)
    side = rng.choice([-1.0, 1.0], n)
    xyz = tip(hidden, q, side) + noise(rng, n)
    return Session.record(q, xyz, approach=side if directions else None)


def tip(hidden: Sequence[HiddenEffect], q: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Where the tip really is, (n, 3) m."""
    sides = np.repeat(side[:, None], ARM.n, axis=1)
    return TrueArm(ARM, hidden).tip(q, TrueContext(approach=sides))


def at(joint: int, value: float) -> np.ndarray:
    """Zeros but for one joint (counted from 1)."""
    made = np.zeros(ARM.n)
    made[joint - 1] = value
    return made


def files_of_a_gain(folder: Path) -> tuple[Path, Path, Path]:
    """Joint 2 goes 2 % too far: arm.yaml, and sessions to diagnose and to test with."""
    gain = (drives.JointGain(at(2, 0.02)),)
    arm, samples, test = (folder / name for name in ("arm.yaml", "samples.csv", "test.csv"))
    arm.write_text(ARM.model_dump_json(exclude_defaults=True))
    write_csv(session(gain), samples)
    write_csv(session(gain, n=40, seed=2), test)
    return arm, samples, test


def calibrated(rows: Session) -> ModelFit:
    """The fit of the geometry to some rows."""
    *_, (_, fitted) = fit_stages(declared_model(ARM), rows)
    return fitted
