"""Engines of the search: machine code, and the model's own code on floats and on arrays.

Both return joints (N, n) and a report (N, 4): position residual (m), angle residual (rad),
iterations, starts.  `tip_poses` and `posture_at` run the model alone by the same machine code.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from enum import Enum
from functools import cache
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context, Layout
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.kernel import Kernel, TwistRow, kept_kernels, kernel_of, works
from longarm_comp.core.model.model import Model, unstack

_FEW = 6  # number of targets up to which floats are faster than arrays
_CHUNK = 4096  # targets at a time: a compromise between calls and cache
NOTHING = Context().layout


class Engine(Enum):
    """The ways to run the search; they differ in speed, and in the last digits of the result."""

    AUTO = "machine code, for a model that is worth its compilation"
    COMPILED = "machine code"
    MODEL = "the model's own code: what machine code is checked against"


AT_ONCE: ContextVar[bool] = ContextVar("compile_at_once", default=False)
"""Whether to compile at the first use (`compile_at_once`)."""


@contextmanager
def compile_at_once() -> Iterator[None]:
    """Compile every model at its first solve within this ``with`` block; each takes a second."""
    token = AT_ONCE.set(True)
    try:
        yield
    finally:
        AT_ONCE.reset(token)


def warm_up(model: Model, context: Context | None = None) -> None:
    """Compile a model to machine code now, for contexts with the same fields as `context`."""
    kernel_of(model, (context or Context()).layout).code  # noqa: B018 - is kept


def run(
    model: Model,
    context: Context,
    engine: Engine,
    m: int,
    targets: np.ndarray,
    starts: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    restarts: int,
    tol: float,
    radian_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Run N searches: from the starts, then from restarts for the targets that failed.

    Args:
        m: 3 for position tasks, 6 for poses.
        targets: position (m) and axes n, o, a, (N, 12).
        starts: (N, n) joints, rad and m.
        box: lower and upper limits, (N, n) each; both are at the start for a locked joint.
        restarts: largest number of restarts of a target (`restart_points`).
        tol: tolerance (m and rad). A target has failed if a residual exceeds it and `REACHED`.
        radian_m: length (m) that a radian of the tool's angle counts as.

    Returns:
        The best joints (N, n) and the report (N, 4) of the module's docstring.
    """
    count, weights = len(targets), (1.0, radian_m)
    points = restart_points(model.arm.n, restarts)
    q, report = np.empty_like(starts), np.zeros((count, 4))
    report[:, :2] = newton.UNKNOWN
    for first in range(0, count, _CHUNK):
        ids = np.arange(first, min(first + _CHUNK, count))
        for s in range(1 + len(points)):
            start, low, high = starts[ids], box[0][ids], box[1][ids]
            if s > 0:
                point, radius = points[s - 1, :-1], points[s - 1, -1]
                start = start + radius * (low + point * (high - low) - start)
                start = np.clip(start, low, high)
            here = context if ids.size == count else context.take(ids)
            worth = engine is Engine.AUTO and _worth_compiling(model, context.layout, ids.size)
            given = {  # by name: (K, k), or one row for all
                "target": targets[ids],
                "lower": low,
                "upper": high,
                "q": start,
                "live": np.ones((ids.size, 1)),
                "tol": np.array([tol]),
                "length": np.array([radian_m]),
                "permitted": np.array([newton.MAX_ITERATIONS]),
            }
            compiled = worth or engine is Engine.COMPILED
            search = _search_compiled if compiled else _search_by_model
            found, left, used = search(model, here, m, given, ids.size)
            report[ids, 2] += used
            report[ids, 3] += 1
            won = left @ weights < report[ids, :2] @ weights
            q[ids[won]], report[ids[won], :2] = found[won], left[won]
            ids = ids[~(left <= max(tol, newton.REACHED)).all(axis=1)]
            if not ids.size:
                break
    return q, report


def _worth_compiling(model: Model, layout: Layout, count: int) -> bool:
    """Count the targets of a batch; tell whether machine code exists or would soon pay off."""
    if not layout.traceable:
        return False
    kernel = kernel_of(model, layout)
    # workload of a batch, in single targets
    kernel.workload += min(count, _FEW + count / 160)
    return AT_ONCE.get() or kernel.is_compiled or kernel.workload > 60


_Given = dict[str, np.ndarray]
_Found = tuple[np.ndarray, np.ndarray, np.ndarray]  # joints (K, n), residuals (K, 2), iterations


class _Search:
    """Searches by the model's own Python code.

    The numbers of the state are floats for a single search, arrays (K,) for K searches.
    """

    def __init__(self, model: Model, context: Context, state: Mapping[str, Sequence[Any]]) -> None:
        self._model, self._context, self.state = model, context, dict(state)
        self._works = works(model, lambda s: context, TwistRow.whole(model, context))

    def run(self, flow: newton.Flow) -> None:
        for step in flow:
            if isinstance(step, str):
                self.state |= self._works[step](self.state)
            else:
                self._repeat(step)

    def _repeat(self, step: newton.Repeat) -> None:
        """Run the steps of a loop until its row of the state is 0 in all searches.

        Searches in which it is 0 are left out of the further rounds.
        """
        while (todo := np.asarray(self.state[step.row][0], dtype=bool)).any():
            if todo.all():
                self.run(step.body)
                continue
            taken = {
                name: [v[todo] if np.ndim(v) else v for v in values]
                for name, values in self.state.items()
            }
            some = _Search(self._model, self._context.take(todo), taken)
            some._repeat(step)
            for name, values in self.state.items():
                whole = [np.array(np.broadcast_to(v, todo.shape)) for v in values]
                for v, new in zip(whole, some.state[name], strict=True):
                    v[todo] = new
                self.state[name] = whole

    def rows(self, name: str, count: int) -> np.ndarray:
        """Return a quantity of the state by its name, (count, k)."""
        return np.stack([np.broadcast_to(v, count) for v in self.state[name]], axis=1)


def _search_by_model(model: Model, context: Context, m: int, given: _Given, count: int) -> _Found:
    flow = newton.flow(model.load_passes, m)
    searches = []
    try:
        for k, single in enumerate(context.each(count) if count <= _FEW else ()):
            state = {name: (v[k] if v.ndim == 2 else v).tolist() for name, v in given.items()}
            searches.append(_Search(model, single, state))
            searches[-1].run(flow)
    except (ArithmeticError, ValueError):  # beyond the range of floats; arrays go on with NaN
        searches.clear()
    if not searches:
        searches.append(_Search(model, context, {k: list(v.T) for k, v in given.items()}))
        with np.errstate(all="ignore"):
            searches[0].run(flow)
    each = count // len(searches)
    q, size, used = (
        np.concatenate([search.rows(name, each) for search in searches])
        for name in ("q", "size", "used")
    )
    return q, size, used[:, 0]


def _search_compiled(model: Model, context: Context, m: int, given: _Given, count: int) -> _Found:
    kernel = kernel_of(model, context.layout)
    packed = {"c": kernel.layout.pack(context, count)}
    blocks = fill_blocks(kernel, given | packed, count)
    kernel.code.function(f"many_search{m}")(blocks.ctypes.data, len(blocks))
    q, size, used = (rows_of(blocks, kernel, name, count) for name in ("q", "size", "used"))
    return q, size, used[:, 0]


def fill_blocks(kernel: Kernel, given: _Given, count: int) -> np.ndarray:
    """Return the states of K searches as blocks for machine code, (blocks, size, width).

    Args:
        given: quantities by name: (K, k), or (k,) if all searches share them. Unused columns of
            the last block are 0 in the former.
        count: number of searches, K.
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
    """Return the quantity called ``name``, (K, k), from blocks that `fill_blocks` made."""
    groups, _, lanes = blocks.shape
    each = blocks[:, kernel.slice(name)].swapaxes(1, 2)
    return each.reshape(groups * lanes, len(kernel.place[name]))[:count]


def tip_poses(model: Model, q: np.ndarray, context: Context | None = None) -> np.ndarray:
    """Return true tip poses as `Model.pose` does, in machine code if the model is compiled.

    Args:
        q: joints (M, n), rad or m.
        context: circumstances of the M postures, scalars or (M,) arrays.

    Returns:
        (M, 4, 4), base frame.
    """
    context = context or Context()
    kernel = compiled_kernel(model, context)
    if kernel is None or not len(q):
        return model.pose(q, context)
    (out,) = evaluate(kernel, q, context, "out")
    poses = np.zeros((len(q), 4, 4))
    poses[:, :3, 3] = out[:, :3]
    poses[:, :3, :3] = out[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2)
    poses[:, 3, 3] = 1.0
    return poses


def posture_at(model: Model, q: np.ndarray, context: Context) -> Posture:
    """Return `Model.posture` at joints (n,) or (M, n), rad and m.

    If the model is compiled, machine code runs the load passes.
    """
    rows, kernel = np.atleast_2d(q), compiled_kernel(model, context)
    if kernel is None or not len(rows):
        return model.posture(unstack(q), context)
    (x,) = evaluate(kernel, rows, context, "x")
    carried = np.ascontiguousarray(x.T) if q.ndim == 2 else x[0].tolist()
    return model.posture_with_twists(unstack(q), context, kernel.row.twists(carried))


def compiled_kernel(model: Model, context: Context) -> Kernel | None:
    """Return the kernel of a model for a context if it is compiled already."""
    layout = context.layout
    kernel = kept_kernels(model).get(layout) if layout.traceable else None
    return kernel if kernel is not None and kernel.is_compiled else None


def evaluate(kernel: Kernel, q: np.ndarray, context: Context, *names: str) -> list[np.ndarray]:
    """Evaluate the model at joints (M, n); return quantities of the state by name, (M, k) each."""
    c = kernel.layout.pack(context, len(q))
    blocks = fill_blocks(kernel, {"trial": q, "c": c}, len(q))
    kernel.code.function("many_evaluate")(blocks.ctypes.data, len(blocks))
    return [rows_of(blocks, kernel, name, len(q)) for name in names]


@cache
def restart_points(n: int, count: int) -> np.ndarray:
    """Return restarts (count, n + 1): a point of the unit box, and how far to go to it.

    The last column is the share of the way from the seed to the point; it is below 1 for the first
    two.  The points are a fixed additive recurrence on the generalised plastic number (M. Roberts'
    R_d).  Every other one is stretched, so that many joints start at a limit.
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
