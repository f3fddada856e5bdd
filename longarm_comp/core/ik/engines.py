"""Engines of the search: machine code, plain Python, arrays, and the model's own code.

All take a `Problem` and return joints (N, n) and a report (N, 4): position residual (m), angle
residual (rad), iterations, starts.
"""

from __future__ import annotations

import importlib.util
import math
from abc import ABC, abstractmethod
from collections import ChainMap
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context, Layout
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.kernel import Kernel, kernel_of, tip_and_jacobian
from longarm_comp.core.model.model import Model

_FEW = 4  # number of targets up to which plain Python is faster than arrays
NOTHING = Context.empty().layout
_THIN = 0.7  # share of active columns below which the finished ones are removed


@dataclass(frozen=True)
class Problem:
    """N searches.

    Attributes:
        targets: position (m) and axes n, o, a, (N, 12).
        m: 3 for position tasks, 6 for poses.
        starts, lower, upper: (N, n); a locked joint has both limits at its start.
        points: restarts (S, n + 1): a point in the unit box and the share of the way to it.
        length: weight of a radian of tool angle, m.
        tol: tolerance of the search on position (m) and angle (rad).
        reached: tolerance of success on both. Targets with larger residuals are restarted.
        max_iterations: per start.
        threads: number of threads, in machine code only.
    """

    targets: np.ndarray
    m: int
    starts: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    points: np.ndarray
    length: float
    tol: float
    reached: float
    max_iterations: int
    threads: int


class Engine(Enum):
    """How to run the search; they differ in speed only."""

    AUTO = "the fastest at hand for so many targets"
    COMPILED = "machine code (needs llvmlite)"
    PYTHON = "the traced model in plain Python, target after target"
    ARRAYS = "the traced model on arrays of targets"
    MODEL = "the model's own code on arrays of targets: what the others are checked against"


class _LongLived:
    """Whether `warm_up` was called. Then every model is compiled on its first use."""

    now = False


@cache
def compiler_at_hand() -> bool:
    """Whether llvmlite is installed. Without it the search is slower."""
    return importlib.util.find_spec("llvmlite") is not None


def warm_up(model: Model | None = None, context: Context | None = None) -> bool:
    """Compile models on their first use from now on. Returns False without the compiler.

    This is for long-lived processes, since a model takes about a second.  A model given here is
    compiled now.
    """
    if compiler_at_hand():
        _LongLived.now = True
        if model is not None:
            kernel_of(model, (context or Context.empty()).layout).code  # noqa: B018 - is kept
    return compiler_at_hand()


def is_compiled(kernel: Kernel, engine: Engine) -> bool:
    """Whether one target would be solved by machine code."""
    if engine is Engine.AUTO:
        return "code" in kernel.__dict__
    return engine is Engine.COMPILED and compiler_at_hand()


def run(
    model: Model, context: Context, problem: Problem, engine: Engine
) -> tuple[np.ndarray, np.ndarray]:
    """Search from the starts, then from the restarts for the targets that failed."""
    p, count = problem, len(problem.targets)
    if engine is Engine.AUTO:
        engine = _chosen(model, context.layout, count)
    search = _SEARCH[engine]
    # targets at a time: a compromise between calls and cache
    chunk = count if engine is Engine.COMPILED else 4096
    q, report = np.empty_like(p.starts), np.zeros((count, 4))
    report[:, :2] = 1e300
    for first in range(0, count, max(chunk, 1)):
        ids = np.arange(first, min(first + chunk, count))
        for s in range(1 + len(p.points)):
            start = p.starts[ids]
            if s > 0:
                low, high = p.lower[ids], p.upper[ids]
                point, radius = p.points[s - 1, :-1], p.points[s - 1, -1]
                start = start + radius * (low + point * (high - low) - start)
                start = np.clip(start, low, high)
            here = context if ids.size == count else context.take(ids)
            given = _given(here, p, ids, start)
            found, left, used = search(model, here, p, given, ids.size)
            report[ids, 2] += used
            report[ids, 3] += 1
            won = left @ (1.0, p.length) < report[ids, :2] @ (1.0, p.length)
            q[ids[won]], report[ids[won], :2] = found[won], left[won]
            ids = ids[~(left <= p.reached).all(axis=1)]
            if not ids.size:
                break
    return q, report


def _chosen(model: Model, layout: Layout, count: int) -> Engine:
    if not layout.traceable:
        return Engine.MODEL
    kernel = kernel_of(model, layout)
    # workload of one target in a batch, in single targets
    kernel.workload += count if count <= _FEW else (1 / 16) * count
    worth = _LongLived.now or kernel.workload > 500  # after so many a model is compiled
    if is_compiled(kernel, Engine.AUTO) or (worth and compiler_at_hand()):
        return Engine.COMPILED
    return Engine.PYTHON if count <= _FEW else Engine.ARRAYS


_Programs = Mapping[str, Callable[[Any], None]]
_Given = dict[str, np.ndarray]
_Found = tuple[np.ndarray, np.ndarray, np.ndarray]  # joints (K, n), residuals (K, 2), iterations


def _given(context: Context, p: Problem, ids: np.ndarray, start: np.ndarray) -> _Given:
    """Inputs of a search by name: (K, k), or one row for all."""
    return {
        "target": p.targets[ids],
        "lower": p.lower[ids],
        "upper": p.upper[ids],
        "q": start,
        "live": np.ones((ids.size, 1)),
        "tol": np.array([p.tol]),
        "permitted": np.array([p.max_iterations]),
        "c": context.layout.pack(context, ids.size),
    }


def _filled(given: dict[str, np.ndarray], kernel: Kernel, count: int) -> np.ndarray:
    """Columns of state, (size, K)."""
    s = np.zeros((kernel.size, count))
    for name, values in given.items():
        s[kernel.slice(name)] = values.T if values.ndim == 2 else values[:, None]
    return s


def _read(s: np.ndarray, kernel: Kernel) -> _Found:
    q, size, used = (s[kernel.slice(name)] for name in ("q", "size", "used"))
    return q.T, size.T, used[0]


class _State(ABC):
    """State of a search, or of several, and the programs on it."""

    def __init__(self, programs: _Programs, place: dict[str, range], s: Any) -> None:
        self.programs, self.place, self.s = programs, place, s

    def run(self, flow: newton.Flow) -> None:
        """Run programs in their order."""
        for step in flow:
            if isinstance(step, str):
                self.programs[step](self.s)
            else:
                self.repeat(self.place[step.row][0], step.body)

    @abstractmethod
    def repeat(self, at: int, body: newton.Flow) -> None:
        """Run until a number of the state is 0 everywhere."""


class _Column(_State):
    """Of one search, as a list of floats."""

    def repeat(self, at: int, body: newton.Flow) -> None:
        while self.s[at]:
            self.run(body)


class _Columns(_State):
    """Of K searches, as rows (size, K)."""

    thin = _THIN

    def repeat(self, at: int, body: newton.Flow) -> None:
        """Finished columns are removed."""
        aside: list[tuple[np.ndarray, np.ndarray]] = []
        while (todo := self.s[at] != 0.0).any():
            if todo.mean() < self.thin:
                aside.append((self.s, todo))
                self.s = self.s[:, todo]
            self.run(body)
        for whole, which in reversed(aside):
            whole[:, which] = self.s
            self.s = whole


def _arrays(model: Model, context: Context, p: Problem, given: _Given, count: int) -> _Found:
    kernel = kernel_of(model, context.layout)
    columns = _Columns(kernel.arrays, kernel.place, _filled(given, kernel, count))
    columns.run(kernel.flows[f"search{p.m}"])
    return _read(columns.s, kernel)


def _python(model: Model, context: Context, p: Problem, given: _Given, count: int) -> _Found:
    kernel = kernel_of(model, context.layout)
    results = []
    for s in _filled(given, kernel, count).T.tolist():
        column = _Column(kernel.floats, kernel.place, s)
        try:
            column.run(kernel.flows[f"search{p.m}"])
        except ArithmeticError:  # beyond the range of numbers, where the other engines give NaN
            for at in kernel.place["size"]:
                s[at] = math.inf
        results.append(s)
    return _read(np.array(results).T, kernel)


def _compiled(model: Model, context: Context, p: Problem, given: _Given, count: int) -> _Found:
    if not compiler_at_hand():
        allowed = "another engine: machine code needs llvmlite (pip install llvmlite)"
        raise InputError("ik", "engine", Engine.COMPILED.name, allowed)
    kernel = kernel_of(model, context.layout)
    blocks = filled_blocks(kernel, given, count)
    search = kernel.code.function(f"many_search{p.m}")  # releases Python's lock
    if p.threads == 1:
        search(blocks.ctypes.data, len(blocks))
    else:
        parts = np.array_split(blocks, p.threads)
        with ThreadPoolExecutor(p.threads) as pool:
            list(pool.map(lambda part: search(part.ctypes.data, len(part)), parts))
    q, size, used = (rows_of(blocks, kernel, name, count) for name in ("q", "size", "used"))
    return q, size, used[:, 0]


def filled_blocks(kernel: Kernel, given: _Given, count: int) -> np.ndarray:
    """States of K searches for machine code, (number, size, width): lanes of `width` columns.

    The last block may be partly used; its other columns are 0.
    """
    width = kernel.code.width
    full, rest = divmod(count, width)
    blocks = np.zeros((full + (rest > 0), kernel.size, width))
    for name, values in given.items():
        part = blocks[:, kernel.slice(name)]
        if values.ndim == 1:
            part[:] = values[:, None]
        else:
            even = values[: count - rest].reshape(full, width, part.shape[1])
            part[:full] = even.swapaxes(1, 2)
            part[full:, :, :rest] = values[count - rest :].T
    return blocks


def rows_of(blocks: np.ndarray, kernel: Kernel, name: str, count: int) -> np.ndarray:
    """(K, k): the quantity of a name in such states."""
    groups, _, lanes = blocks.shape
    each = blocks[:, kernel.slice(name)].swapaxes(1, 2)
    return each.reshape(groups * lanes, len(kernel.place[name]))[:count]


def _model(model: Model, context: Context, p: Problem, given: _Given, count: int) -> _Found:
    """The search on arrays, with the model's own code and all load passes at every step."""
    kernel = kernel_of(Model(model.arm), NOTHING)
    out = kernel.slice("out")

    def evaluate(s: np.ndarray) -> None:
        posture = model.posture(tuple(s[kernel.slice("trial")]), context)
        for row, value in zip(s[out], tip_and_jacobian(model, posture), strict=True):
            row[:] = value

    own: dict[str, Any] = {"rigid": evaluate, "tip": evaluate, "first": _nothing, "again": _nothing}
    s = _filled({**given, "c": np.zeros(0)}, kernel, count)
    columns = _Columns(ChainMap(own, kernel.arrays), kernel.place, s)
    columns.thin = 0.0  # the context is of all columns
    columns.run(kernel.flows[f"search{p.m}"])
    return _read(s, kernel)


def _nothing(s: np.ndarray) -> None:
    """Placeholder: no twists are carried."""


_SEARCH: dict[Engine, Callable[[Model, Context, Problem, _Given, int], _Found]] = {
    Engine.COMPILED: _compiled,
    Engine.PYTHON: _python,
    Engine.ARRAYS: _arrays,
    Engine.MODEL: _model,
}


@cache
def restart_points(n: int, count: int) -> np.ndarray:
    """(count, n + 1): points of the unit box, and the share of the way from the seed to each.

    A fixed additive recurrence on the generalised plastic number (M. Roberts' R_d).  The first
    points stay near the seed.  Every other one is stretched, so that many joints start at a limit,
    as taught poses often are.
    """
    g = 2.0
    for _ in range(40):
        g = (1 + g) ** (1 / (n + 1))
    steps = (1 / g) ** np.arange(1, n + 1)
    points = np.ones((count, n + 1))
    points[:, :-1] = (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0
    points[1::2, :-1] = np.clip(0.5 + 1.6 * (points[1::2, :-1] - 0.5), 0.0, 1.0)
    points[:2, -1] = (0.25, 0.5)[:count]
    return points
