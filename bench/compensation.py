"""Benchmarks of compensation in one process, with a predictor of negligible cost."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from bench.arms import demo_arm
from bench.comparison import Result, alone, beside
from bench.kinematics import soft_model, time_calls
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.result import Compensation, Method, Prediction
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.ik import solver as ik
from longarm_comp.workflows.compensate_path import compensate_path
from studies.path import ELASTIC, PLAY, StudiedArm, way


class _Smooth:
    """A predictor of negligible cost, so that only the compensation is timed."""

    def predict(self, q: np.ndarray, context: Any = None) -> Any:
        """Some 2 mm down, growing with the first joint."""
        error = np.tile([1e-3, 0.0, -2e-3], (len(q), 1)) * (1.0 + q[:, :1])
        sigma, inside = np.full_like(error, 1e-4), np.ones(len(q), bool)
        return Prediction(error, sigma, inside)


def compensate_batch_10000(count: int = 10_000) -> Result:
    """Physics and predictor, passes until the expected error settles."""
    model = soft_model(demo_arm())
    targets = model.tip(random_joints(model.arm, count, 5))

    def work(_: int) -> list[Compensation]:
        return compensate(model, _Smooth(), targets, method=Method.BOTH)

    with ik.compile_at_once():
        batch = work(0)
    rates = count / time_calls(work, range(5), time.process_time)
    success, passes = np.mean([(one.success, one.passes) for one in batch], axis=0)
    note = f"success {success:.4f}, {passes:.1f} passes"
    return alone("targets/s", rates, note)


def compensate_single() -> Result:
    """One target after another."""
    model = soft_model(demo_arm())
    targets = model.tip(random_joints(model.arm, 200, 5))

    def work(i: int) -> None:
        compensate(model, _Smooth(), targets[i], method=Method.BOTH)

    with ik.compile_at_once():
        time_calls(work, range(20))
    each = 1e6 * time_calls(work, range(200)).reshape(8, -1)
    return alone("us", np.median(each, axis=1), "one target, all passes")


def path(way_points: int, play: bool = False) -> Result:
    """Way-points of one arc, judged by the uncertainty of a calibrated model; goal 200 us each."""
    number = int(play)
    names = (*ELASTIC, PLAY) if play else ELASTIC
    studied = StudiedArm.draw(demo_arm(), number, 1, names)
    plan = way(studied.arm, "arc", 0.05, np.random.default_rng([1, number, 1])).plan
    assert plan.joints is not None and plan.times is not None
    rows = np.linspace(0, len(plan.times) - 1, way_points).round().astype(int)
    targets, seed = plan.targets[rows], plan.joints[0]
    times = plan.times[-1] * np.linspace(0.0, 1.0, way_points)

    def work(_: int) -> None:
        compensate_path(studied.model, targets, times=times, seed=seed, frame="measured")

    with ik.compile_at_once():
        time_calls(work, range(5))
    each = 1e6 / way_points * time_calls(work, range(40), time.process_time).reshape(8, -1)
    note = f"{way_points} way-points, {len(studied.model.slots)} parameters"
    return beside("us a way-point", np.median(each, axis=1), "goal", [200.0], note=note)
