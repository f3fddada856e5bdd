"""Single targets by machine code: what does not change from target to target is prepared once."""

from __future__ import annotations

from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context, Layout
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.engines import NOTHING, Engine
from longarm_comp.core.ik.kernel import Kernel, kernel_of
from longarm_comp.core.model.model import Model

# layout, equations, tolerance, weight of a radian (m)
_Key = tuple[Layout | None, int, float, float]
# joints (n,); position (m) and angle (rad) residuals, iterations, fault
_Found = tuple[np.ndarray, list[float]]
_BOX = ("lower", "upper")


class _Workspace:
    """The state of one search: the first column of a block, with views of inputs and results."""

    def __init__(self, kernel: Kernel, key: _Key) -> None:
        _, m, tol, length = key
        block = np.zeros((kernel.size, kernel.code.width))
        column = block[:, 0]
        column[kernel.slice("live")] = 1.0
        column[kernel.slice("tol")], column[kernel.slice("length")] = tol, length
        column[kernel.slice("permitted")] = newton.MAX_ITERATIONS
        for name, limits in zip(_BOX, kernel.arm.box_about(kernel.arm.mid), strict=True):
            block[kernel.slice(name)] = limits[:, None]
        self.box = [column[kernel.slice(name)] for name in _BOX]
        self.given = column[kernel.slice("given")].reshape(4, 4)
        self.position = self.given[:3, 3]
        self.seed, self.q = column[kernel.slice("seed")], column[kernel.slice("q")]
        self.context = column[kernel.slice("c")]
        self.packed: Context | None = None  # the one that is in there
        self.report = column[kernel.place["size"].start : kernel.place["fault"].stop]
        self.block = block  # keeps the memory of the views
        self.address = block.ctypes.data
        self.search = kernel.code.function(f"solve{m}")


class _Task:
    """Single searches that differ only in target, seed and numbers of the context."""

    def __init__(self, kernel: Kernel, key: _Key) -> None:
        self.kernel, self.key = kernel, key
        self.endless = bool(np.isinf(kernel.arm.bounds[1]).any())
        self.spare = [_Workspace(kernel, key)]

    def run(self, target: np.ndarray, seed: np.ndarray, context: Context | None) -> _Found | None:
        """Search from the seed without restarts; None if the target or the seed is invalid."""
        if seed.shape != (self.kernel.arm.n,):
            return None
        try:
            workspace = self.spare.pop()
        except IndexError:  # another thread uses it
            workspace = _Workspace(self.kernel, self.key)
        if target.size == 3:
            workspace.given[...] = 0.0
            workspace.position[...] = target
        else:
            workspace.given[...] = target
        workspace.seed[...] = seed
        if self.endless:
            workspace.box[0][...], workspace.box[1][...] = self.kernel.arm.box_about(seed)
        if context is not workspace.packed and context is not None:
            workspace.context[...] = self.kernel.layout.pack(context, 1)[0]
            workspace.packed = context
        workspace.search(workspace.address)
        report, q = workspace.report.tolist(), workspace.q.copy()
        self.spare.append(workspace)
        return None if report[-1] else (q, report)


def solve_compiled(
    model: Model,
    target: np.ndarray,
    seed: np.ndarray | None,
    context: Context | None,
    options: tuple[int, float, float],
    engine: Engine,
) -> _Found | None:
    """Search from a seed (default mid-range) in machine code.

    None if the request needs the general solver: the model is not compiled, a text column of the
    context has several values, or the input is invalid and needs an error message.

    Args:
        target: (3,), m, or (4, 4), base frame.
        options: number of equations, tolerance (m and rad), and weight of a radian (m).
    """
    key = (None if context is None else context.layout, *options)
    tasks: dict[Any, _Task] = model.memo.setdefault("tasks", {})
    task = tasks.get(key)
    if task is None:
        layout = key[0] or NOTHING
        if not layout.traceable or not options[1] > 0:
            return None
        kernel = kernel_of(model, layout)
        if engine is not Engine.COMPILED and not kernel.is_compiled:
            return None
        task = tasks[key] = _Task(kernel, key)
    return task.run(target, task.kernel.arm.mid if seed is None else np.asarray(seed), context)
