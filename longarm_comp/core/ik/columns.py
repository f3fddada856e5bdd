"""The tip and its derivatives by parameters at commands, in machine code if that is compiled."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import IDENTITY, Vec
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.engines import (
    AT_ONCE,
    compiled_kernel,
    evaluate,
    fill_blocks,
    posture_at,
    rows_of,
)
from longarm_comp.core.ik.kernel import Kernel
from longarm_comp.core.model.model import Model, Slot, unstack
from longarm_comp.core.model.tip_motion import TipMotion, stack, trace_shifts

_WORTH = 200.0
"""Number of commands, one by one, that take as long by the model's own code as compiling."""


def tip_and_columns(
    model: Model, q: np.ndarray, context: Context, slots: Sequence[Slot]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true tip (..., 3), m, and `Model.columns` (M, 3, p) of p parameters.

    Args:
        q: (n,) or (M, n) joints, rad and m.
        context: circumstances of all, or of each.
        slots: parameters of the arm; the model need not hold them.
    """
    rows = np.atleast_2d(q)
    kernel = compiled_kernel(model, context)
    columns = None if kernel is None else _columns_of(model, kernel, slots, len(rows))
    if kernel is None or columns is None:
        at = posture_at(model, q, context)
        derivatives = model.columns(at, slots)[1].reshape(-1, 3, len(slots))
        return stack(model.tip_frame(at).p), derivatives
    out, x = evaluate(kernel, rows, context, "out", "x")
    tip, made = out[:, :3], columns.compute(rows, x, context)
    if model.biases:  # columns are of what is measured
        bare = model.posture_without_frames(unstack(rows), context)
        frame = IDENTITY._replace(p=tuple(tip.T))
        made = TipMotion(model, bare, frame, (), ()).pull("position") @ made
    return tip.reshape(*q.shape[:-1], 3), made


def _columns_of(
    model: Model, kernel: Kernel, slots: Sequence[Slot], count: int
) -> _ColumnKernel | None:
    """Return the machine code for parameters; None if few commands were judged by them so far."""
    kept: dict[Any, _ColumnKernel] = model.memo.setdefault("columns", {})
    key = kernel.layout, tuple([slot.identity for slot in slots])
    if key not in kept:
        kept[key] = _ColumnKernel(model, kernel, slots)
    columns = kept[key]
    columns.workload += 1.0 + count / 64
    ready = AT_ONCE.get() or columns.is_compiled or columns.workload > _WORTH
    return columns if ready else None


class _ColumnKernel(Kernel):
    """The derivatives of the tip by parameters, at the postures that a kernel evaluates."""

    def __init__(self, model: Model, kernel: Kernel, slots: Sequence[Slot]) -> None:
        super().__init__(model, kernel.layout)
        self._base, self._slots = kernel, slots

    @cached_property
    def place(self) -> dict[str, range]:
        """Layout of the state; the columns are three numbers a parameter."""
        sizes = (self.arm.n, self.layout.count, len(self._base.row.slot), 3 * len(self._slots))
        ends = np.cumsum((0, *sizes)).tolist()
        spans = zip(("trial", "c", "x", "columns"), ends, ends[1:], strict=False)
        return {name: range(begin, end) for name, begin, end in spans}

    def _compile(self) -> Any:
        return self._compile_works({"columns": self._trace}, {}, level=0)

    def _trace(self, s: newton.State) -> newton.Outcome:
        model, context = self._model, self.layout.unpack(s["c"])
        twists = self._base.row.twists(s["x"])
        posture = model.posture_with_twists(tuple(s["trial"]), context, twists)
        changes: Any = model.list_changes(posture, self._slots)
        shifts: list[Vec] = trace_shifts(posture, model.tip_frame(posture).p, changes)
        return {"columns": [component for shift in shifts for component in shift]}

    def compute(self, q: np.ndarray, x: np.ndarray, context: Context) -> np.ndarray:
        """Return the derivatives (M, 3, p) at joints (M, n) and twists (M, k) of the kernel."""
        given = {"trial": q, "c": self.layout.pack(context, len(q)), "x": x}
        blocks = fill_blocks(self, given, len(q))
        self.code.function("many_columns")(blocks.ctypes.data, len(blocks))
        made = rows_of(blocks, self, "columns", len(q)).reshape(len(q), len(self._slots), 3)
        return made.swapaxes(1, 2)
