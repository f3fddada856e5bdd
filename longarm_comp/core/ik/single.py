"""Single targets by machine code: what does not change from target to target is prepared once."""

from __future__ import annotations

from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.engines import NOTHING, Engine
from longarm_comp.core.ik.kernel import Kernel, kernel_of
from longarm_comp.core.model.model import Model

# joints (n,); position (m) and angle (rad) residuals, iterations, fault
_Found = tuple[np.ndarray, list[float]]
_BOX = ("lower", "upper")


class _Workspace:
    """The state of one search: the first column of a block, with views of inputs and results."""

    def __init__(self, kernel: Kernel, options: tuple[int, float, float]) -> None:
        m, tol, length = options
        block = np.zeros((kernel.size, kernel.code.width))
        column = block[:, 0]
        column[kernel.slice("live")] = 1.0
        column[kernel.slice("tol")], column[kernel.slice("length")] = tol, length
        column[kernel.slice("permitted")] = newton.MAX_ITERATIONS
        for name, limits in zip(_BOX, kernel.arm.box_about(kernel.arm.mid), strict=True):
            block[kernel.slice(name)] = limits[:, None]
        self.kernel, self.endless = kernel, bool(np.isinf(kernel.arm.bounds[1]).any())
        self.box = [column[kernel.slice(name)] for name in _BOX]
        self.given = column[kernel.slice("given")].reshape(4, 4)
        self.position = self.given[:3, 3]
        self.seed, self.q = column[kernel.slice("seed")], column[kernel.slice("q")]
        self.context = column[kernel.slice("c")]
        self.packed: Context | None = None  # the one that is in there
        self.report = column[kernel.place["size"].start : kernel.place["fault"].stop]
        self.block = block  # keeps the memory of the views
        self.address = block.ctypes.data
        self.function = kernel.code.function(f"solve{m}")

    def search(self, target: np.ndarray, seed: np.ndarray, context: Context | None) -> _Found:
        """Search from the seed without restarts."""
        if target.size == 3:
            self.given[...] = 0.0
            self.position[...] = target
        else:
            self.given[...] = target
        self.seed[...] = seed
        if self.endless:
            self.box[0][...], self.box[1][...] = self.kernel.arm.box_about(seed)
        if context is not self.packed and context is not None:
            self.context[...] = self.kernel.layout.pack(context, 1)[0]
            self.packed = context
        self.function(self.address)
        return self.q.copy(), self.report.tolist()


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
    seed = model.arm.mid if seed is None else np.asarray(seed)
    if seed.shape != (model.arm.n,):
        return None
    layout = NOTHING if context is None else context.layout
    spare: dict[Any, list[_Workspace]] = model.memo.setdefault("workspaces", {})
    free = spare.setdefault((layout, *options), [])
    try:
        workspace = free.pop()
    except IndexError:  # there is none yet, or another thread uses it
        if not layout.traceable or not options[1] > 0:
            return None
        kernel = kernel_of(model, layout)
        if engine is not Engine.COMPILED and not kernel.is_compiled:
            return None
        workspace = _Workspace(kernel, options)
    found = workspace.search(target, seed, context)
    free.append(workspace)
    return None if found[1][-1] else found
