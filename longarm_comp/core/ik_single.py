"""One target by the compiled search, with next to nothing around it.

What does not change from target to target is made once per model and task.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from longarm_comp.core.context import Context
from longarm_comp.core.ik_engines import characteristic_length, restart_points
from longarm_comp.core.kernel import Layout, kernel_of
from longarm_comp.core.model import Model

ROTATION_TOLERANCE = 1e-6
Limits = tuple[tuple[str, float, float], ...]  # name, lower, upper of every joint
# joints (n,); the same and position residual, angle residual, iterations, starts, 0; limits
Found = tuple[np.ndarray, list[float], Limits]
Options = tuple[bool, float, int, int]  # position_only, tol, max_iterations, max_starts
Key = tuple[Layout | None, int, float, int, int]  # layout, equations, the last three of the options

_NOTHING = Layout.of(Context.empty())


class _Task:
    """A task's constants, as the compiled search takes them (see `newton_numba.search_one`)."""

    def __init__(self, model: Model, key: Key) -> None:
        given, m, tol, max_iterations, max_starts = key
        layout = given or _NOTHING
        arm, kernel = model.arm, kernel_of(model, layout)
        points = restart_points(arm.n, max(max_starts - 1, 0))
        self.kernel = kernel  # keeps the machine code
        self.columns = layout.approach + len(layout.columns)
        self.n, self.layout, self.mid = arm.n, layout, arm.mid
        self.numbers = np.array(
            [
                *kernel.machine,
                *(m, kernel.nx, arm.n, max(1, self.columns), len(points), max_iterations),
            ],
            dtype=np.intp,
        )
        self.constants = np.array(
            [
                *(characteristic_length(model), tol, ROTATION_TOLERANCE**2),
                *(*arm.lower, *arm.upper, *(arm.upper - arm.lower), *points.ravel()),
            ]
        )
        self.size = 16 + 2 * arm.n + max(1, self.columns) + 5
        self.fixed = self.numbers.ctypes.data, self.constants.ctypes.data
        self.call = _search()
        self.limits = tuple(
            zip(arm.joint_names, arm.lower.tolist(), arm.upper.tolist(), strict=True)
        )
        self.spare: list[tuple[np.ndarray, int]] = []  # working memory and its address

    def run(self, target: np.ndarray, seed: Any, context: Context | None) -> Found | None:
        """See `solve_compiled`."""
        n = self.n
        try:
            data, address = self.spare.pop()
        except IndexError:  # the first, or another thread holds it
            data = np.empty(self.size)
            address = data.ctypes.data
        if target.size == 3:
            data[:16] = 0.0
            data[3:12:4] = target
        else:
            data[:16] = target.ravel()
        start = self.mid if seed is None else np.asarray(seed)
        if start.shape != (n,):
            return None
        data[16 : 16 + n] = start
        if self.columns:
            assert context is not None
            data[16 + n : -5 - n] = self.layout.pack(context, 1)[0]
        self.call(*self.fixed, address)
        report = data[-5 - n :].tolist()
        q = data[-5 - n : -5].copy()
        self.spare.append((data, address))
        return None if report[-1] else (q, report, self.limits)


@cache
def _search() -> Any:
    from longarm_comp.core.newton_numba import by_address

    return by_address()


def solve_compiled(
    model: Model, target: np.ndarray, seed: Any, context: Context | None, options: Options
) -> Found | None:
    """Solve by the compiled search.

    None where the request needs the long way: text columns, or input that is wrong and has to
    be named.
    """
    position_only, tol, max_iterations, max_starts = options
    layout = None if context is None else Layout.of(context)
    m = 3 if position_only or target.size == 3 else 6
    key = (layout, m, tol, max_iterations, max_starts)
    tasks: dict[Key, _Task] | None = model.__dict__.get("_tasks")
    if tasks is None:
        tasks = model.__dict__["_tasks"] = {}
    task = tasks.get(key)
    if task is None:
        if (layout and not layout.traceable) or not tol > 0:
            return None
        task = tasks[key] = _Task(model, key)
    return task.run(target, seed, context)
