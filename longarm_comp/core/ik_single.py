"""One target by the compiled search, with next to nothing around it.

What does not change from target to target is made once per model and task.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.context import Context
from longarm_comp.core.ik_engines import characteristic_length, restart_points
from longarm_comp.core.kernel import Kernel, Layout, kernel_of
from longarm_comp.core.model import Model

ROTATION_TOLERANCE = 1e-6
Options = tuple[bool, float, int, int]  # position_only, tol, max_iterations, max_starts


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A task's constants, as the compiled search takes them."""

    kernel: Kernel
    machine: tuple[int, ...]
    lower: np.ndarray
    upper: np.ndarray
    span: np.ndarray
    mid: np.ndarray
    points: np.ndarray
    length: float


_NOTHING = Layout.of(Context.empty())
_NO_COLUMNS = np.zeros((1, 1))


def solve_compiled(
    model: Model, target: np.ndarray, seed: Any, context: Context | None, options: Options
) -> tuple[np.ndarray, list[float]] | None:
    """Joints (n,) and [position residual, angle residual, iterations, starts].

    Returns None where the request needs the long way: text columns, or input that is wrong
    and has to be named.
    """
    from longarm_comp.core.newton_numba import search_one

    position_only, tol, max_iterations, max_starts = options
    layout = _NOTHING if context is None else Layout.of(context)
    if not layout.traceable or not tol > 0:
        return None
    task = _prepared(model, layout, max_starts)
    n = task.span.shape[0]
    data = np.empty(12 + n)
    if target.shape == (3,):
        m = 3
        data[:3], data[3:12] = target, 0.0
    else:
        m = 3 if position_only else 6
        data[:3] = target[:3, 3]
        data[3:12].reshape(3, 3)[:] = target[:3, :3].T
        if m == 6 and target[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            return None
    start = task.mid if seed is None else np.asarray(seed, dtype=float)
    if start.shape != (n,):
        return None
    data[12:] = start
    columns = _NO_COLUMNS if context is None else layout.pack(context, 1)
    q, report = np.empty((1, n)), np.zeros((1, 4))
    fault = search_one(
        task.machine, m, task.kernel.nx, data, columns, task.lower, task.upper, task.span,
        task.points, task.length, tol, max_iterations, ROTATION_TOLERANCE**2, q, report,
    )  # fmt: skip
    return None if fault else (q[0], report[0].tolist())


def at_limits(model: Model, q: np.ndarray) -> tuple[str, ...]:
    """Names of the joints that stand on a limit."""
    limits = model.__dict__.get("_limits")
    if limits is None:
        arm = model.arm
        limits = tuple(zip(arm.joint_names, arm.lower.tolist(), arm.upper.tolist(), strict=True))
        model.__dict__["_limits"] = limits
    return tuple(
        name
        for value, (name, low, high) in zip(q.tolist(), limits, strict=True)
        if value <= low or value >= high
    )


def _prepared(model: Model, layout: Layout, max_starts: int) -> _Prepared:
    held: dict[tuple[Layout, int], _Prepared] = model.__dict__.setdefault("_prepared", {})
    key = (layout, max_starts)
    if key not in held:
        arm, kernel = model.arm, kernel_of(model, layout)
        held[key] = _Prepared(
            kernel,
            kernel.machine,
            arm.lower[None].copy(),
            arm.upper[None].copy(),
            arm.upper - arm.lower,
            arm.mid,
            restart_points(arm.n, max(max_starts - 1, 0)),
            characteristic_length(model),
        )
    return held[key]
