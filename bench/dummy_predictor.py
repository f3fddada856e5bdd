"""A dummy predictor of the usual size, trained on a synthetic residual."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Provenance
from longarm_comp.core.learn.predictor_file import save

_SAMPLES = 300


def train_dummy(arm: Arm, path: Path) -> None:
    """Train on a smooth residual of a few millimetres over the joint box, and save."""
    rng = np.random.default_rng(0)
    q = rng.uniform(arm.lower, arm.upper, (_SAMPLES, arm.n))
    share = (q - arm.mid) / (arm.upper - arm.lower)
    error = 3e-3 * np.stack([np.sin(3 * share[:, k] + share[:, k + 1]) for k in range(3)], -1)
    error += 1e-4 * rng.standard_normal(error.shape)
    origin = Provenance(arm.hash, "", arm.joint_names, {"deflection": True})
    save(train(q, error, hidden=12, iterations=10, provenance=origin), path)
