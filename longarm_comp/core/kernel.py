"""The model as small programs, for the inverse kinematics.

`first` gives the twists under the rigid arm's loads, `step` the tip, its Jacobian and the
next twists at given ones, `last` the tip and its Jacobian alone; `solve3` and `solve6` are
the damped least-squares step, unrolled.  All are traced from the package's own Python, so
they give its numbers; parameters are constants in them, joints and context are inputs.  They
run on floats, on arrays, or (with llvmlite, which numba brings) as machine code, compiled in
a fraction of a second.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from longarm_comp.core import emit
from longarm_comp.core.box_step import solve_damped
from longarm_comp.core.context import Context
from longarm_comp.core.jacobian import geometric
from longarm_comp.core.model import Model
from longarm_comp.core.trace import Symbol, Tape

NAMES = ("first", "step", "last", "solve3", "solve6")
_KEPT = 32  # kernels held, the latest used


@dataclass(frozen=True)
class Layout:
    """Which context a kernel reads: column k of its context rows."""

    approach: int
    columns: tuple[str, ...]
    labels: tuple[tuple[str, object], ...]

    @classmethod
    def of(cls, context: Context) -> Layout:
        """The layout that fits a context; its text columns become constants."""
        labels = tuple(sorted(context.labels.items()))
        return cls(len(context.approach), tuple(sorted(context.columns)), labels)

    @property
    def traceable(self) -> bool:
        """Whether one kernel serves all rows: no text column changes from row to row."""
        return all(isinstance(value, str) for _, value in self.labels)

    def symbols(self, tape: Tape) -> Context:
        """The context as inputs of a kernel."""
        made = [tape.input(f"c[{k}]") for k in range(self.approach + len(self.columns))]
        named = dict(zip(self.columns, made[self.approach :], strict=True))
        return Context(tuple(made[: self.approach]), named, dict(self.labels))

    def pack(self, context: Context, count: int) -> np.ndarray:
        """Context of N targets as rows, (N, columns)."""
        values = [*context.approach, *(context.columns[name] for name in self.columns)]
        rows = np.empty((count, max(1, len(values))))
        for k, value in enumerate(values):
            rows[:, k] = value
        return rows


class Kernel:
    """The traced programs of one model.

    Attributes:
        n: commanded joints; nx: numbers that the twists take; passes: load passes.
        layout: the context it reads.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        tape = Tape()
        self.n, self.layout, self.passes = model.arm.n, layout, model.load_passes
        q = tuple(tape.input(f"q[{i}]") for i in range(self.n))
        context = layout.symbols(tape)
        start = model.twists(model.loaded(q, context, {}))
        fixed = _fixed_twists(model, layout)
        slot: dict[tuple[int, int], int] = {}
        for s in sorted(start):
            for i in range(6):
                if (s, i) not in fixed:
                    slot[s, i] = len(slot)
        self.nx = len(slot)
        twists = {
            s: tuple(
                fixed[s, i] if (s, i) in fixed else tape.input(f"x[{slot[s, i]}]") for i in range(6)
            )
            for s in start
        }
        posture = model.loaded(q, context, twists)  # type: ignore[arg-type]
        again = model.twists(posture)
        tip = model.tip_frame(posture)
        seen = [*tip.p, *tip.n, *tip.o, *tip.a]
        columns = geometric(posture, tip.p)
        seen += [column[i // 3][i % 3] for i in range(6) for column in columns]
        out: emit.Outputs = {f"out[{k}]": value for k, value in enumerate(seen)}
        self.programs: dict[str, tuple[Tape, emit.Outputs]] = {
            "first": (tape, {f"y[{k}]": start[s][i] for (s, i), k in slot.items()}),
            "step": (tape, {**out, **{f"y[{k}]": again[s][i] for (s, i), k in slot.items()}}),
            "last": (tape, out),
            "solve3": _solver(3, self.n),
            "solve6": _solver(6, self.n),
        }

    def _python(self, functions: Mapping[str, Any]) -> tuple[Any, ...]:
        text = "\n".join(emit.python(name, *self.programs[name]) for name in NAMES)
        space = dict(functions)
        exec(compile(text, "<traced model>", "exec"), space)
        return (*(space[name] for name in NAMES), self.passes)

    @cached_property
    def floats(self) -> tuple[Any, ...]:
        """The programs on lists of floats, in the order of `NAMES`, then the passes."""
        return self._python(emit.FLOATS)

    @cached_property
    def arrays(self) -> tuple[Any, ...]:
        """As `floats`, on (k, N) arrays; x and y must not be the same."""
        return self._python(emit.ARRAYS)

    @cached_property
    def machine(self) -> tuple[int, ...]:
        """As `floats`, addresses of machine code on arrays of doubles."""
        return (*(self.code.address(name) for name in NAMES), self.passes)

    @cached_property
    def code(self) -> Any:
        """The machine code, kept as long as the kernel."""
        from longarm_comp.core import machine_code

        return machine_code.compile_module(emit.llvm(self.programs))


def _solver(m: int, n: int) -> tuple[Tape, emit.Outputs]:
    """`solve_damped` for m equations and n unknowns: q = J, c = e, x = free and damping, y = u."""
    tape = Tape()
    J = [tape.input(f"q[{k}]") for k in range(m * n)]
    e = [tape.input(f"c[{k}]") for k in range(m)]
    free = [tape.input(f"x[{k}]") for k in range(n + 1)]
    u: list[Any] = [0.0] * n
    solve_damped(J, e, free, free[n], m, n, [0.0] * (m * m), [0.0] * m, u)
    return tape, {f"y[{k}]": value for k, value in enumerate(u)}


def _fixed_twists(model: Model, layout: Layout) -> dict[tuple[int, int], float]:
    """Components of twists (station, number) that neither joints, context nor loads move."""
    tape = Tape()
    q = tuple(tape.input(f"q[{i}]") for i in range(model.arm.n))
    context = layout.symbols(tape)
    start = model.twists(model.loaded(q, context, {}))
    free = {s: tuple(tape.input(f"x[{s}, {i}]") for i in range(6)) for s in start}
    again = model.twists(model.loaded(q, context, free))  # type: ignore[arg-type]
    return {
        (s, i): float(start[s][i])
        for s in start
        for i in range(6)
        if not isinstance(again[s][i], Symbol) and again[s][i] == start[s][i]
    }


_kernels: OrderedDict[tuple[Any, ...], Kernel] = OrderedDict()


def kernel_of(model: Model, layout: Layout) -> Kernel:
    """The kernel of a model, traced on first use and kept by content."""
    held: dict[Layout, Kernel] = model.__dict__.setdefault("_kernels", {})
    if layout not in held:
        key = (model.arm.hash, repr(model.effects), model.passes, model.elements_per_beam, layout)
        if key not in _kernels:
            _kernels[key] = Kernel(model, layout)
        _kernels.move_to_end(key)
        while len(_kernels) > _KEPT:
            _kernels.popitem(last=False)
        held[layout] = _kernels[key]
    return held[layout]
