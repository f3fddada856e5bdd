"""The ways to run the search: machine code, plain Python, arrays, and the model itself.

All take a `Problem` and give joints (N, n) and a report (N, 4): position residual (m), angle
residual (rad), iterations, starts.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from longarm_comp.core import newton
from longarm_comp.core.box_step import solve_damped
from longarm_comp.core.context import Context
from longarm_comp.core.jacobian import geometric
from longarm_comp.core.kernel import Layout, kernel_of
from longarm_comp.core.model import Model
from longarm_comp.core.newton_batch import Machine, Task, TracedArrays, search

_CHUNK = 1024  # targets whose arrays stay in the processor's cache
_FEW = 4  # targets up to which plain Python is ahead of arrays
_COMPILE_AFTER = 500  # targets solved without, before the compiled loop is fetched unasked


@dataclass(frozen=True)
class Problem:
    """N searches.

    Attributes:
        targets: position (m) and axes n, o, a, (N, 12).
        m: 3 for position tasks, 6 for poses.
        starts, lower, upper: (N, n); a locked joint has both limits at its start.
        span: range of each joint (n,).
        points: restarts (S, n + 1): a point in the unit box and how far to go to it (0 to 1).
        length: metres that a radian of tool angle counts for.
        tol: on position (m) and angle (rad).
        max_iterations: per start.
    """

    targets: np.ndarray
    m: int
    starts: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    span: np.ndarray
    points: np.ndarray
    length: float
    tol: float
    max_iterations: int


class Engine(Enum):
    """How to run the search; they differ in speed only."""

    AUTO = "the fastest at hand for so many targets"
    COMPILED = "machine code (needs numba)"
    PYTHON = "the traced model in plain Python, target after target"
    ARRAYS = "the traced model on arrays of targets"
    MIXED = "machine code for the model, arrays for the search (needs llvmlite)"
    MODEL = "the model's own code on arrays of targets: what the others are checked against"


class _Compiled:
    """The compiled loop, once it is here."""

    loop: Any = None
    solved = 0


def numba_at_hand() -> bool:
    """Whether the optional compiler is installed."""
    return importlib.util.find_spec("numba") is not None


def warm_up() -> bool:
    """Fetch the compiled search now, not at the first target; False where numba is missing.

    Call it when a node starts: it takes some seconds the first time on a machine, and well
    under one from then on.
    """
    if _Compiled.loop is None and numba_at_hand():
        from longarm_comp.core.newton_numba import search_all

        _Compiled.loop = search_all
    return _Compiled.loop is not None


def characteristic_length(model: Model) -> float:
    """Metres that a radian of tool angle counts for: a quarter of the stretched arm."""
    size = sum(abs(j.a_m) + abs(j.d_m) for j in model.arm.joints)
    return max(0.25 * size, 0.01)


def compiled_at_hand(engine: Engine) -> bool:
    """Whether one target would be solved by the compiled loop, as far as the engine goes."""
    if engine is Engine.AUTO:
        return _Compiled.loop is not None
    return engine is Engine.COMPILED and warm_up()


def run(
    model: Model, context: Context, problem: Problem, engine: Engine
) -> tuple[np.ndarray, np.ndarray]:
    """Search with an engine."""
    count = len(problem.targets)
    layout = Layout.of(context)
    if engine is Engine.AUTO:
        engine = _chosen(layout, count)
    return _RUN[engine](model, context, layout, problem)


def _chosen(layout: Layout, count: int) -> Engine:
    if not layout.traceable:
        return Engine.MODEL
    _Compiled.solved += count
    if _Compiled.loop is not None or (_Compiled.solved > _COMPILE_AFTER and warm_up()):
        return Engine.COMPILED
    if importlib.util.find_spec("llvmlite") is not None:
        return Engine.MIXED
    return Engine.PYTHON if count <= _FEW else Engine.ARRAYS


def _compiled(
    model: Model, context: Context, layout: Layout, p: Problem
) -> tuple[np.ndarray, np.ndarray]:
    if not warm_up():
        raise RuntimeError("the compiled search needs numba: pip install longarm_comp[fast]")
    kernel, count = kernel_of(model, layout), len(p.targets)
    q, report = np.empty((count, model.arm.n)), np.zeros((count, 4))
    _Compiled.loop(
        kernel.machine, p.m, kernel.nx, p.targets, layout.pack(context, count), p.starts, p.lower,
        p.upper, p.span, p.points, p.length, p.tol, p.max_iterations, q, report,
    )  # fmt: skip
    return q, report


def _python(
    model: Model, context: Context, layout: Layout, p: Problem
) -> tuple[np.ndarray, np.ndarray]:
    kernel, count = kernel_of(model, layout), len(p.targets)
    q = [[0.0] * model.arm.n for _ in range(count)]
    report = [[0.0] * 4 for _ in range(count)]
    newton.search_all(
        kernel.floats, p.m, kernel.nx, p.targets.tolist(), layout.pack(context, count).tolist(),
        p.starts.tolist(), p.lower.tolist(), p.upper.tolist(), p.span.tolist(),
        p.points.tolist(), p.length, p.tol, p.max_iterations, q, report,
    )  # fmt: skip
    return np.array(q), np.array(report)


def _arrays(
    model: Model, context: Context, layout: Layout, p: Problem
) -> tuple[np.ndarray, np.ndarray]:
    rows = np.ascontiguousarray(layout.pack(context, len(p.targets)).T)
    return _in_chunks(TracedArrays(kernel_of(model, layout), rows), p)


def _mixed(
    model: Model, context: Context, layout: Layout, p: Problem
) -> tuple[np.ndarray, np.ndarray]:
    from longarm_comp.core.machine_rows import MachineRows

    rows = layout.pack(context, len(p.targets))
    return _in_chunks(MachineRows(kernel_of(model, layout), rows), p)


def _model(
    model: Model, context: Context, layout: Layout, p: Problem
) -> tuple[np.ndarray, np.ndarray]:
    return _in_chunks(_ModelMachine(model, context), p)


_RUN: dict[Engine, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    Engine.COMPILED: _compiled,
    Engine.PYTHON: _python,
    Engine.ARRAYS: _arrays,
    Engine.MIXED: _mixed,
    Engine.MODEL: _model,
}


class _ModelMachine:
    """The model's own code, all load passes at every step."""

    def __init__(self, model: Model, context: Context) -> None:
        self.model, self.context = model, context

    def step(self, q: np.ndarray, ids: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Machine`."""
        return self.full(q, ids)[0], x

    def full(self, q: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Machine`; no twists are carried."""
        posture = self.model.posture(tuple(q), self.context.take(ids))
        tip = self.model.tip_frame(posture)
        columns = geometric(posture, tip.p)
        values = [*tip.p, *tip.n, *tip.o, *tip.a]
        values += [column[i // 3][i % 3] for i in range(6) for column in columns]
        out = np.empty((len(values), ids.size))
        for k, value in enumerate(values):
            out[k] = value
        return out, np.empty((0, ids.size))

    def solve(self, m: int, J: np.ndarray, e: np.ndarray, free: np.ndarray) -> np.ndarray:
        """See `Machine`."""
        n, count = len(free) - 1, e.shape[1]
        A, y, u = np.empty((m * m, count)), np.empty((m, count)), np.empty((n, count))
        solve_damped(J, e, free, free[n], m, n, A, y, u)
        return u


def _in_chunks(machine: Machine, p: Problem) -> tuple[np.ndarray, np.ndarray]:
    task = Task(
        np.ascontiguousarray(p.targets.T),
        p.m,
        np.ascontiguousarray(p.lower.T),
        np.ascontiguousarray(p.upper.T),
        p.span,
        p.length,
        p.tol,
    )
    q, report = np.empty_like(p.starts), np.zeros((len(p.targets), 4))
    for first in range(0, len(q), _CHUNK):
        ids = np.arange(first, min(first + _CHUNK, len(q)))
        _restarted(machine, task, p, ids, q, report)
    return q, report


def _restarted(
    machine: Machine, task: Task, p: Problem, ids: np.ndarray, q: np.ndarray, report: np.ndarray
) -> None:
    """Search from the starts, then from elsewhere for those that failed."""
    report[ids, :2] = 1e300
    for s in range(1 + len(p.points)):
        start, low, high = p.starts[ids], p.lower[ids], p.upper[ids]
        if s > 0:
            point, radius = p.points[s - 1, :-1], p.points[s - 1, -1]
            start = start + radius * (low + point * (high - low) - start)
            start = np.clip(start, low, high)
        found, left, used = search(
            machine, task, ids, np.ascontiguousarray(start.T), p.max_iterations
        )
        report[ids, 2] += used
        report[ids, 3] += 1
        held = report[ids, 0] + p.length * report[ids, 1]
        won = left[0] + p.length * left[1] < held
        q[ids[won]], report[ids[won], :2] = found[:, won].T, left[:, won].T
        ids = ids[(left > p.tol).any(axis=0)]
        if not ids.size:
            break


@cache
def restart_points(n: int, count: int) -> np.ndarray:
    """(count, n + 1): points of the unit box and how far to go from the seed to each.

    An additive recurrence on the plastic number's generalisation (M. Roberts' R_d), the same
    every time.  The first stay near the seed; every other one is stretched so that many joints
    start on a limit, where taught poses tend to be.
    """
    g = 2.0
    for _ in range(40):
        g = (1 + g) ** (1 / (n + 1))
    steps = (1 / g) ** np.arange(1, n + 1)
    return with_radii((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0)


def with_radii(points: np.ndarray) -> np.ndarray:
    """Points (S, n) stretched and with their radii, (S, n + 1)."""
    made = np.ones((len(points), points.shape[1] + 1))
    made[:, :-1] = points
    made[1::2, :-1] = np.clip(0.5 + 1.6 * (points[1::2] - 0.5), 0.0, 1.0)
    made[:2, -1] = (0.25, 0.5)[: len(points)]
    return made
