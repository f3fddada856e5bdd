"""Benchmarks of inverse kinematics against peers in one run.

The peers solve the *rigid* arm, this package the deflected one: targets are each model's own
poses of the same random joints.  An answer counts where its error is below 1e-5 m and inside
the limits.  The sides alternate in blocks, so that both are measured under the same load.  Ratios
above 1 mean faster than the peer.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from bench import ik_peers
from bench.arms import demo_arm
from bench.comparison import Result, alone, beside, missing
from bench.ik_peers import Toolbox
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import paper_grid, random_joints
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.solver import Engine
from longarm_comp.core.model.model import Model

TOLERANCE = 1e-7  # m and rad, ten times tighter than that of the peers
BLOCKS = 8
PER_BLOCK = 50
BATCH = 4000


def soft_model(arm: Arm, elements_per_beam: int = 2) -> Model:
    """A model with link deflection and joint compliance."""
    soft = tuple(JointCompliance(row, 1e-3) for row in arm.commanded if row in (1, 2, 5, 6))
    return Model(arm, (LinkDeflection(), *soft), elements_per_beam=elements_per_beam)


Clock = Callable[[], float]


def time_calls(
    work: Callable[[int], Any], rows: Sequence[int], clock: Clock = time.perf_counter
) -> np.ndarray:
    """Seconds of single calls."""
    seconds = []
    for i in rows:
        begin = clock()
        work(i)
        seconds.append(clock() - begin)
    return np.array(seconds)


def _in_turns(
    ours: Callable[[int], Any], theirs: Callable[[int], Any], per_block: int
) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of single calls, (BLOCKS, per_block) each."""
    times: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for block in range(BLOCKS):
        rows = range(block * per_block, (block + 1) * per_block)
        for side, solve in zip(times, (ours, theirs), strict=True):
            side.append(time_calls(solve, rows))
    return np.array(times[0]), np.array(times[1])


def single(peer_name: str, warm: bool = False, per_block: int | None = None) -> Result:
    """Medians of single pose tasks, from mid-range or from joints 1 % of their range away (warm).

    Goals beside `Toolbox`: 3 (ambitious: 7) from mid-range, 1.5 warm.
    """
    model, per_block = soft_model(demo_arm()), per_block or PER_BLOCK
    kind: Any = getattr(ik_peers, peer_name)
    arm = model.arm
    ik.warm_up(model)
    try:
        peer = kind(arm)
    except ImportError as error:
        return missing(kind.name, f"not installed: {error.name}")
    q = random_joints(arm, BLOCKS * per_block, 1)
    seeds, targets, rigid = (
        _near(arm, q) if warm else np.tile(arm.mid, (len(q), 1)),
        model.pose(q),
        Model(arm).pose(q),
    )

    def our(i: int) -> np.ndarray:
        return ik.solve(model, targets[i], seed=seeds[i], tol=TOLERANCE).q

    def their(i: int) -> np.ndarray:
        return peer.solve(rigid[i], seeds[i])

    solved = [
        _solved_share(of, np.array([work(i) for i in range(len(q))]), goals)
        for of, work, goals in ((model, our, targets), (Model(arm), their, rigid))
    ]
    ours, theirs = _in_turns(our, their, per_block)
    return beside(
        "us",
        1e6 * np.median(ours, axis=1),
        peer.name,
        1e6 * np.median(theirs, axis=1),
        mean=1e6 * float(ours.mean()),
        peer_mean=1e6 * float(theirs.mean()),
        note=f"solved {solved[0]:.3f}, peer {solved[1]:.3f}",
    )


def _solved_share(model: Model, q: np.ndarray, targets: np.ndarray) -> float:
    arm, given = model.arm, np.isfinite(q).all(axis=1)
    error = np.linalg.norm(model.tip(np.nan_to_num(q)) - targets[:, :3, 3], axis=1)
    inside = ((q >= arm.lower - 1e-9) & (q <= arm.upper + 1e-9)).all(axis=1)
    return float((given & inside & (error < 1e-5)).mean())


def _near(arm: Arm, q: np.ndarray) -> np.ndarray:
    shift = 0.01 * (arm.upper - arm.lower) * np.where(np.arange(arm.n) % 2, 1.0, -1.0)
    return np.clip(q + shift, arm.lower, arm.upper)


def batch(grid: bool = False) -> Result:
    """Poses a second of a batch from mid-range, beside the peer's mean rate on the same joints.

    Of random joints, or of the paper's grid: on limits and at singularities. Goals: 20.
    """
    model = soft_model(demo_arm())
    arm = model.arm
    q = paper_grid(arm) if grid else random_joints(arm, BATCH, 2)
    ik.warm_up(model)
    try:
        peer = Toolbox(arm)
    except ImportError as error:
        return missing(Toolbox.name, f"not installed: {error.name}")
    targets, mid = model.pose(q), arm.mid
    some = np.random.default_rng(0).permutation(len(q))[: BLOCKS * PER_BLOCK]
    rigid = Model(arm).pose(q[some])
    solve = partial(ik.solve_many, model, tol=TOLERANCE)
    solved, clock = solve(targets).ok.mean(), time.process_time
    ours, theirs = [], []
    for block in range(BLOCKS):
        rows = range(block * PER_BLOCK, (block + 1) * PER_BLOCK)
        ours.append(len(q) / time_calls(lambda _: solve(targets), [0], clock)[0])
        theirs.append(1 / time_calls(lambda i: peer.solve(rigid[i], mid), rows, clock).mean())
    note = f"processor seconds; solved {solved:.4f}"
    rate = [float(np.mean(theirs))]
    return beside("poses/s", ours, Toolbox.name, rate, more_is_better=True, note=note)


def single_uncompiled() -> Result:
    """Time targets by the model's own code, as the first ones before a model is compiled."""
    model = soft_model(demo_arm())
    targets = model.pose(random_joints(model.arm, 8 * BLOCKS, 3))
    solve = partial(ik.solve, model, tol=TOLERANCE, engine=Engine.MODEL)
    each = time_calls(lambda i: solve(targets[i]), range(8 * BLOCKS), time.process_time)
    return alone("us", 1e6 * np.median(each.reshape(BLOCKS, -1), 1), "the model's own code")


def batch_uncompiled() -> Result:
    """The same on arrays."""
    model = soft_model(demo_arm())
    targets = model.pose(random_joints(model.arm, BATCH, 3))
    solve = partial(ik.solve_many, model, tol=TOLERANCE, engine=Engine.MODEL)
    rates = BATCH / time_calls(lambda _: solve(targets), range(5), time.process_time)
    return alone("poses/s", rates, "the model's own code")


def compile_seconds() -> Result:
    """Time to trace and compile a model, for which its first target waits."""
    arm = demo_arm()

    def work(k: int) -> None:
        ik.warm_up(soft_model(arm, elements_per_beam=2).plus(JointCompliance(4, 1e-4 * (k + 1))))

    seconds = time_calls(work, range(3), time.process_time)
    return alone("s", seconds, "trace and compile, once a model")
