"""Kinematics measured beside its peers in one run.

``python -m longarm_comp.bench.kinematics`` prints these figures.  The peers solve the *rigid*
arm, this package the deflected one: targets are each model's own poses of the same random
joints.  A peer's answer counts where its error is below 1e-5 m and inside the limits.  Sides
take turns in blocks, so that both meet the machine in the same mood; ratios above 1 mean
faster than the peer.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from longarm_comp.bench.arms import demo_arm
from longarm_comp.core import ik
from longarm_comp.core.arm import Arm
from longarm_comp.core.compensate import Method, compensate_many
from longarm_comp.core.effects.joint_compliance import JointCompliance
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.ik import Engine
from longarm_comp.core.kernel import Layout, kernel_of
from longarm_comp.core.model import Model
from longarm_comp.core.newton import LEVELS, evaluation

Result = dict[str, object]

TOLERANCE = 1e-7  # m and rad, ten times closer than what is asked of the peers
BLOCKS = 8
PER_BLOCK = 50


def soft_model(arm: Arm, elements_per_beam: int = 2) -> Model:
    """Links that sag and joints that give way."""
    soft = tuple(JointCompliance(row, 1e-3) for row in arm.commanded if row in (1, 2, 5, 6))
    return Model(arm, (LinkDeflection(), *soft), elements_per_beam=elements_per_beam)


class Toolbox:
    """roboticstoolbox-python on the rigid arm (C++ `ik_LM`, `eval`)."""

    name = "roboticstoolbox-python ik_LM (rigid, tol 1e-12)"

    def __init__(self, arm: Arm) -> None:
        from roboticstoolbox import ET, ETS

        chain: list[Any] = []
        for joint in arm.joints:
            turn, shift = np.radians(joint.alpha_deg), np.radians(joint.theta_offset_deg)
            chain += [ET.Rx(turn), ET.tx(joint.a_m), ET.Rz(shift)]
            if joint.type == "revolute":
                chain += [ET.Rz(qlim=list(joint.limits)), ET.tz(joint.d_m)]
            else:
                chain += [ET.tz(joint.d_m), ET.tz(qlim=list(joint.limits))]
        self.ets: Any = ETS([e for e in chain if e.isjoint or e.param != 0.0])  # type: ignore[operator]

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """Joints (n,)."""
        return np.asarray(self.ets.ik_LM(target, q0=seed, tol=1e-12).q)


def _random(arm: Arm, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, arm.n))


def _timed(solve: Callable[[int], Any], rows: Sequence[int]) -> np.ndarray:
    seconds = []
    for i in rows:
        begin = time.perf_counter()
        solve(i)
        seconds.append(time.perf_counter() - begin)
    return np.array(seconds)


def _in_turns(
    ours: Callable[[int], Any], theirs: Callable[[int], Any], blocks: int
) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of single calls, (blocks, PER_BLOCK) each."""
    made: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for block in range(blocks):
        rows = range(block * PER_BLOCK, (block + 1) * PER_BLOCK)
        for side, solve in zip(made, (ours, theirs), strict=True):
            side.append(_timed(solve, rows))
    return np.array(made[0]), np.array(made[1])


def _row(name: str, value: float, unit: str, peer: str, theirs: float, each: np.ndarray) -> Result:
    return {
        "name": name,
        "value": float(value),
        "unit": unit,
        "peer": peer,
        "peer_value": float(theirs),
        "ratio": float(np.median(each)),
        "spread": [float(each.min()), float(each.max())],
    }


def _missing(name: str, peer: str) -> Result:
    note = f"{peer} is not installed"
    empty = dict.fromkeys(("value", "unit", "peer_value", "ratio", "spread"))
    return {"name": name, "peer": peer, "note": note, **empty}


def _single(name: str, model: Model, start: Callable[[np.ndarray], np.ndarray]) -> Result:
    """Medians of single pose tasks; `start` makes the seeds of given joints."""
    try:
        peer = Toolbox(model.arm)
    except ImportError:
        return _missing(name, Toolbox.name)
    engine = _fastest()
    q = _random(model.arm, BLOCKS * PER_BLOCK, 1)
    seeds, targets, rigid = start(q), model.pose(q), Model(model.arm).pose(q)
    ok = [
        ik.solve(model, t, seed=s, tol=TOLERANCE, engine=engine).ok
        for t, s in zip(targets, seeds, strict=True)
    ]
    theirs_ok = _peer_ok(
        model.arm, np.array([peer.solve(t, s) for t, s in zip(rigid, seeds, strict=True)]), rigid
    )
    ours, theirs = _in_turns(
        lambda i: ik.solve(model, targets[i], seed=seeds[i], tol=TOLERANCE, engine=engine),
        lambda i: peer.solve(rigid[i], seeds[i]),
        BLOCKS,
    )
    each = np.median(theirs, axis=1) / np.median(ours, axis=1)
    row = _row(name, 1e6 * np.median(ours), "us", Toolbox.name, 1e6 * np.median(theirs), each)
    note = f"{engine.name.lower()}; solved {np.mean(ok):.3f}, peer {theirs_ok:.3f}"
    return {**row, "note": note}


def _peer_ok(arm: Arm, q: np.ndarray, targets: np.ndarray) -> float:
    error = np.linalg.norm(Model(arm).tip(q) - targets[:, :3, 3], axis=1)
    inside = ((q >= arm.lower - 1e-9) & (q <= arm.upper + 1e-9)).all(axis=1)
    return float(((error < 1e-5) & inside).mean())


def _fastest() -> Engine:
    return Engine.COMPILED if ik.warm_up() else Engine.PYTHON


def ik_single_vs_rtb_ik_lm_median(model: Model | None = None) -> Result:
    """One pose from mid-range; goal 3, ambitious 7."""
    model = model or soft_model(demo_arm())
    mid = model.arm.mid
    return _single("ik_single_vs_rtb_ik_lm_median", model, lambda q: np.tile(mid, (len(q), 1)))


def ik_warm_vs_rtb_ik_lm_median(model: Model | None = None) -> Result:
    """One pose from joints 1 % of their range away; goal 1.5."""
    model = model or soft_model(demo_arm())
    arm = model.arm
    span = arm.upper - arm.lower
    shift = 0.01 * span * np.where(np.arange(arm.n) % 2, 1.0, -1.0)

    def near(q: np.ndarray) -> np.ndarray:
        return np.clip(q + shift, arm.lower, arm.upper)

    return _single("ik_warm_vs_rtb_ik_lm_median", model, near)


def ik_batch_vs_rtb_ik_lm_mean(model: Model | None = None, engine: Engine | None = None) -> Result:
    """Poses per second of a batch against the peer's mean rate; goal 20."""
    model = model or soft_model(demo_arm())
    name = "ik_batch_vs_rtb_ik_lm_mean"
    try:
        peer = Toolbox(model.arm)
    except ImportError:
        return _missing(name, Toolbox.name)
    if engine is None:
        engine = Engine.COMPILED if ik.warm_up() else Engine.ARRAYS
    q, count = _random(model.arm, 4000, 2), BLOCKS * PER_BLOCK
    targets, rigid, mid = model.pose(q), Model(model.arm).pose(q[:count]), model.arm.mid
    ik.solve_many(model, targets[:600], tol=TOLERANCE, engine=engine)
    ours, theirs, solved = [], [], 1.0
    for block in range(BLOCKS):
        begin = time.perf_counter()
        made = ik.solve_many(model, targets, tol=TOLERANCE, engine=engine)
        ours.append(len(q) / (time.perf_counter() - begin))
        solved = min(solved, float(made.ok.mean()))
        rows = range(block * PER_BLOCK, (block + 1) * PER_BLOCK)
        theirs.append(1 / _timed(lambda i: peer.solve(rigid[i], mid), rows).mean())
    each = np.array(ours) / np.mean(theirs)
    row = _row(name, float(np.median(ours)), "poses/s", Toolbox.name, float(np.mean(theirs)), each)
    return {**row, "note": f"{engine.name.lower()}; solved {solved:.3f}"}


def ik_without_numba() -> list[Result]:
    """Plain Python for one pose and arrays for many: goals 400 us and 30,000/s."""
    model = soft_model(demo_arm())
    targets, mid = model.pose(_random(model.arm, 4000, 3)), model.arm.mid
    ik.solve(model, targets[0], engine=Engine.PYTHON)
    one = _timed(
        lambda i: ik.solve(model, targets[i], seed=mid, tol=TOLERANCE, engine=Engine.PYTHON),
        range(40),
    )
    rows = [_row("ik_single_python", 1e6 * np.median(one), "us", "goal", 400.0, 400e-6 / one)]
    for engine in (Engine.ARRAYS,):
        rates = []
        for _ in range(3):
            begin = time.perf_counter()
            ik.solve_many(model, targets, tol=TOLERANCE, engine=engine)
            rates.append(len(targets) / (time.perf_counter() - begin))
        name, goal = f"ik_batch_{engine.name.lower()}", np.array(rates) / 30e3
        rows.append(_row(name, float(np.median(rates)), "poses/s", "goal", 30e3, goal))
    return rows


def fk_vs_peers() -> list[Result]:
    """Deflected tip, pose and Jacobian against rigid FK alone."""
    arm = demo_arm()
    model = soft_model(arm)
    q = _random(arm, 2048, 4)
    kernel = kernel_of(model, Layout.of(ik.Context.empty()))
    state = np.zeros((kernel.size, len(q)))
    state[kernel.slice("trial")] = q.T

    def traced() -> None:
        for name in evaluation(LEVELS[-1], kernel.passes, anew=True):
            kernel.arrays[name](state)

    made = []
    sides: list[tuple[str, Callable[[], Any], int]] = []
    try:
        peer = Toolbox(arm)
        sides.append(("roboticstoolbox-python eval, batch", lambda: peer.ets.eval(q), len(q)))
    except ImportError:
        made.append(_missing("fk_batch_vs_rtb", "roboticstoolbox-python"))
    ours: dict[str, tuple[Callable[[], Any], int]] = {
        "fk_batch_model": (lambda: model.tip(q), len(q)),
        "fk_batch_traced_with_jacobian": (traced, len(q)),
        "fk_single_model": (lambda: model.tip(q[0]), 1),
    }
    for name, (work, count) in ours.items():
        for peer_name, theirs, peer_count in sides:
            mine = _per_pose(work, count)
            other = _per_pose(theirs, peer_count)
            made.append(
                _row(
                    name,
                    1e6 * np.median(mine),
                    "us",
                    peer_name,
                    1e6 * np.median(other),
                    other / mine,
                )
            )
    return made


def _per_pose(work: Callable[[], Any], count: int, repeats: int = 7) -> np.ndarray:
    work()
    return _timed(lambda _: work(), range(repeats)) / count


class _Constant:
    """A predictor that costs nothing: what is timed is the compensation."""

    def predict(self, q: np.ndarray, context: Any = None) -> Any:
        """2 mm down, everywhere."""
        from types import SimpleNamespace

        error = np.tile([1e-3, 0.0, -2e-3], (len(q), 1)) * (1.0 + q[:, :1])
        return SimpleNamespace(
            error=error, sigma=np.full_like(error, 1e-4), in_domain=np.ones(len(q), bool)
        )


def compensation_batch(count: int = 10_000) -> Result:
    """Targets to commands, all passes, one process."""
    model = soft_model(demo_arm())
    targets = model.tip(_random(model.arm, count, 5))
    ik.warm_up()
    rates, solved = [], 1.0
    for _ in range(3):
        begin = time.perf_counter()
        made = compensate_many(model, _Constant(), targets, method=Method.BOTH)
        rates.append(count / (time.perf_counter() - begin))
        solved = min(solved, float(made.success.mean()))
    row = _row(
        "compensate_batch_10000",
        float(np.median(rates)),
        "targets/s",
        "none",
        np.nan,
        np.array(rates),
    )
    return {**row, "peer_value": None, "ratio": None, "note": f"success {solved:.4f}"}


def main() -> None:
    """Print all rows as JSON."""
    rows = [
        ik_single_vs_rtb_ik_lm_median(),
        ik_warm_vs_rtb_ik_lm_median(),
        ik_batch_vs_rtb_ik_lm_mean(),
        *ik_without_numba(),
        *fk_vs_peers(),
        compensation_batch(),
    ]
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    print(json.dumps({"machine": machine, "results": rows}, indent=1))


if __name__ == "__main__":
    main()
