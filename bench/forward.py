"""Benchmarks of forward kinematics: the deflected arm against rigid ones, and its columns."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.arms import demo_arm
from bench.comparison import Result, alone, beside, missing
from bench.ik_peers import Pinocchio, Toolbox
from bench.kinematics import soft_model, time_calls
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.kernel import kernel_of
from longarm_comp.core.model.model import Model, unstack

COUNT = 4096
REPEATS = 7

Work = tuple[Callable[[], Any], int]  # what is timed, and how many poses it makes


def machine_forward(model: Model, q: np.ndarray) -> Callable[[], None]:
    """Deflected tip pose and Jacobian at joints (N, n), in machine code; N a multiple of 8."""
    kernel = kernel_of(model, ik.Context().layout)
    width = kernel.code.width
    blocks = np.zeros((len(q) // width, kernel.size, width))
    blocks[:, kernel.slice("trial")] = q.reshape(-1, width, q.shape[1]).swapaxes(1, 2)
    evaluate = kernel.code.function("many_evaluate")
    return lambda: evaluate(blocks.ctypes.data, len(blocks))


def _per_pose(work: Work) -> np.ndarray:
    call, count = work
    call()
    return 1e6 * time_calls(lambda _: call(), range(REPEATS), time.process_time) / count


def _toolbox(arm: Arm, q: np.ndarray) -> Work:
    ets = Toolbox(arm).ets
    return lambda: ets.eval(q), len(q)


def _pinocchio(arm: Arm, q: np.ndarray) -> Work:
    peer = Pinocchio(arm)
    jacobians, model, data = peer.package.computeJointJacobians, peer.model, peer.data

    def work() -> None:
        for one in q[:512]:
            jacobians(model, data, one)

    return work, 512


PEERS = {
    "roboticstoolbox-python eval (rigid, batch)": _toolbox,
    "pinocchio computeJointJacobians (rigid, from Python one by one)": _pinocchio,
}


def beside_rigid(library: str) -> Result:
    """Time poses of 4096 joints in machine code against a library's rigid forward kinematics."""
    peer, kind = next((name, kind) for name, kind in PEERS.items() if name.startswith(library))
    model = soft_model(demo_arm())
    q = random_joints(model.arm, COUNT, 4)
    try:
        theirs = kind(model.arm, q)
    except ImportError as error:
        return missing(peer, f"not installed: {error.name}")
    ours = machine_forward(model, q), COUNT
    turns = [(_per_pose(ours), _per_pose(theirs)) for _ in range(REPEATS)]
    mine, other = (
        np.array([np.median(side) for side in sides]) for sides in zip(*turns, strict=True)
    )
    return beside("us", mine, peer, other, note="tip and Jacobian of the deflected arm")


def batch_model() -> Result:
    """Time poses by the model's own code."""
    model = soft_model(demo_arm())
    q = random_joints(model.arm, COUNT, 4)
    each = _per_pose((lambda: model.tip(q), COUNT))
    return alone("us", each, "deflected tip by the model's own code, NumPy")


def single_model() -> Result:
    """One pose by the model's own code."""
    model = soft_model(demo_arm())
    one = unstack(random_joints(model.arm, 1, 4)[0])
    each = _per_pose((lambda: model.posture(one), 1))
    return alone("us", each, "posture with loads by the model's own code")


def columns(count: int | None = None) -> Result:
    """Prediction and columns of poses, 4096 by default."""
    count = COUNT if count is None else count
    model = soft_model(demo_arm())
    q = random_joints(model.arm, count, 5)
    posture = model.posture(unstack(q[0] if count == 1 else q))
    note = f"{len(model.slots)} parameters by Eq. (5), posture at hand, the model's own code"
    return alone("us", _per_pose((lambda: model.columns(posture), count)), note)


def cost() -> Result:
    """Machine code against the number of effects, beam elements and load passes."""
    arm = demo_arm()
    soft = soft_model(arm)
    found = [e for name in sorted(BUILT_IN) for e in BUILT_IN[name].for_arm(arm)]
    many = tuple(_with_values(e) for e in found if isinstance(e, Effect) and not e.needs)
    models = {
        "rigid": Model(arm),
        "1 element a beam": soft_model(arm, 1),
        "4 elements": soft_model(arm, 4),
        "1 load pass": dataclasses.replace(soft, passes=1),
        f"all {len(many)} effects at once": Model(arm, many),
    }
    q = random_joints(arm, COUNT, 6)
    costs = {name: _per_pose((machine_forward(m, q), COUNT)) for name, m in models.items()}
    note = "5 effects, 2 elements a beam, 3 load passes; " + ", ".join(
        f"{name}: {np.median(each):.2f}" for name, each in costs.items()
    )
    return alone("us", _per_pose((machine_forward(soft, q), COUNT)), note)


def _with_values(effect: Effect) -> Effect:
    """The effect with non-zero parameters, so that no term is folded away."""
    return effect.with_values(
        {p.name: max(0.1 * p.prior, p.lower) for p in effect.declared() if p.prior > 0}
    )
