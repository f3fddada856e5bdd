"""One target by machine code, with next to nothing around it.

What does not change from target to target is made once per model and task.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context, Layout
from longarm_comp.core.ik.engines import Engine, is_compiled
from longarm_comp.core.ik.kernel import Kernel, kernel_of
from longarm_comp.core.model.model import Model

Key = tuple[Layout | None, int, float, int]  # layout, equations, tolerance, iterations
# joints (n,); position (m) and angle (rad) that are left, iterations, joints at limits, fault
Found = tuple[np.ndarray, list[float]]

_NOTHING = Context.empty().layout


class _Workspace:
    """A block of columns of which the first is at work, and views of what goes in and out."""

    def __init__(self, kernel: Kernel, key: Key) -> None:
        _, m, tol, max_iterations = key
        block = np.zeros((kernel.size, kernel.code.width))
        column = block[:, 0]
        column[kernel.slice("live")] = 1.0
        column[kernel.slice("tol")], column[kernel.slice("permitted")] = tol, max_iterations
        for name in ("lower", "upper"):
            block[kernel.slice(name)] = getattr(kernel, name)[:, None]
        self.given = column[kernel.slice("given")].reshape(4, 4)
        self.position = self.given[:3, 3]
        self.seed, self.q = column[kernel.slice("seed")], column[kernel.slice("q")]
        self.context = column[kernel.slice("c")]
        self.report = column[kernel.place["size"].start : kernel.place["fault"].stop]
        self.block = block  # what the views show
        self.address = block.ctypes.data
        self.search = kernel.code.function(f"solve{m}")


class Task:
    """Single searches that differ in target, seed and numbers of context alone."""

    def __init__(self, kernel: Kernel, key: Key) -> None:
        self.kernel, self.key = kernel, key
        self.spare = [_Workspace(kernel, key)]

    def run(self, target: np.ndarray, seed: np.ndarray, context: Context | None) -> Found | None:
        """Search from the seed alone; None where the target or the seed is wrong."""
        if seed.shape != self.kernel.mid.shape:
            return None
        try:
            desk = self.spare.pop()
        except IndexError:  # another thread holds it
            desk = _Workspace(self.kernel, self.key)
        if target.size == 3:
            desk.given[...] = 0.0
            desk.position[...] = target
        else:
            desk.given[...] = target
        desk.seed[...] = seed
        if context is not None:
            desk.context[...] = self.kernel.layout.pack(context, 1)[0]
        desk.search(desk.address)
        report, q = desk.report.tolist(), desk.q.copy()
        self.spare.append(desk)
        return None if report[-1] else (q, report)


def solve_compiled(
    model: Model,
    target: np.ndarray,
    seed: np.ndarray | None,
    context: Context | None,
    options: tuple[int, float, int],
    engine: Engine,
) -> Found | None:
    """Search from a seed (default mid-range) in machine code; options: m, tolerance, iterations.

    None where the request needs the long way: not compiled by now, text columns, input that is
    wrong and has to be named.
    """
    key = (None if context is None else context.layout, *options)
    tasks: dict[Any, Task] = model.__dict__.setdefault("_tasks", {})
    task = tasks.get(key)
    if task is None:
        layout = key[0] or _NOTHING
        if not layout.traceable or not options[1] > 0:
            return None
        kernel = kernel_of(model, layout)
        if not is_compiled(kernel, engine):
            return None
        task = tasks[key] = Task(kernel, key)
    return task.run(target, task.kernel.mid if seed is None else np.asarray(seed), context)
