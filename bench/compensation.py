"""Benchmarks of compensation in one process, with a predictor of negligible cost."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from bench.arms import demo_arm
from bench.comparison import Result, alone
from bench.kinematics import soft_model, timed
from longarm_comp.core.compensation.compensate import Method, compensate
from longarm_comp.core.compensation.result import Compensation
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.ik import solver as ik


class _Smooth:
    """A predictor of negligible cost, so that only the compensation is timed."""

    def predict(self, q: np.ndarray, context: Any = None) -> Any:
        """Some 2 mm down, growing with the first joint."""
        error = np.tile([1e-3, 0.0, -2e-3], (len(q), 1)) * (1.0 + q[:, :1])
        sigma, inside = np.full_like(error, 1e-4), np.ones(len(q), bool)
        return SimpleNamespace(error=error, sigma=sigma, in_domain=inside)


def compensate_batch_10000(count: int = 10_000) -> Result:
    """Physics and predictor, passes until the expected error settles."""
    model = soft_model(demo_arm())
    targets = model.tip(random_joints(model.arm, count, 5))
    ik.warm_up()

    def work(_: int) -> list[Compensation]:
        return [compensate(model, _Smooth(), target, method=Method.BOTH) for target in targets]

    batch = work(0)
    rates = count / timed(work, range(5), time.process_time)
    success, passes = np.mean([(one.success, one.passes) for one in batch], axis=0)
    note = f"success {success:.4f}, {passes:.1f} passes"
    return alone("targets/s", rates, note)


def compensate_single() -> Result:
    """One target after another."""
    model = soft_model(demo_arm())
    targets = model.tip(random_joints(model.arm, 200, 5))
    ik.warm_up()

    def work(i: int) -> None:
        compensate(model, _Smooth(), targets[i], method=Method.BOTH)

    timed(work, range(20))
    each = 1e6 * timed(work, range(200)).reshape(8, -1)
    return alone("us", np.median(each, axis=1), "one target, all passes")
