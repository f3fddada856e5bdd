"""`newton`, compiled: the same functions with the machine's five replaced.

The loop knows kernels by address only, so it is compiled once for all models and kept in
numba's cache (some 10 s the first time, well under a second later).
"""

from __future__ import annotations

import types
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import types as nb
from numba.extending import intrinsic

from longarm_comp.core import box_step, newton


@intrinsic
def _call(context: Any, address: Any, q: Any, c: Any, x: Any, out: Any, y: Any) -> tuple[Any, Any]:
    """Call ``void (*)(double*, ...)`` at an address, with buffers given by address."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        function = ir.FunctionType(ir.VoidType(), [pointer] * 5)
        called = builder.inttoptr(args[0], function.as_pointer())
        builder.call(called, [builder.inttoptr(a, pointer) for a in args[1:]])
        return context.get_dummy_value()

    return nb.void(*[nb.intp] * 6), code


def _buffer(size: int) -> Any:
    return np.zeros(size)


def _first(k: Any, q: Any, c: Any, x: Any, out: Any, y: Any) -> None:
    _call(k[0], q.ctypes.data, c.ctypes.data, x.ctypes.data, out.ctypes.data, y.ctypes.data)


def _step(k: Any, q: Any, c: Any, x: Any, out: Any, y: Any) -> None:
    _call(k[1], q.ctypes.data, c.ctypes.data, x.ctypes.data, out.ctypes.data, y.ctypes.data)


def _last(k: Any, q: Any, c: Any, x: Any, out: Any, y: Any) -> None:
    _call(k[2], q.ctypes.data, c.ctypes.data, x.ctypes.data, out.ctypes.data, y.ctypes.data)


def _least_squares(k: Any, m: int, J: Any, e: Any, free: Any, u: Any) -> None:
    at = k[4] if m == 6 else k[3]
    _call(at, J.ctypes.data, e.ctypes.data, free.ctypes.data, u.ctypes.data, u.ctypes.data)


_MACHINE = {
    "buffer": _buffer,
    "first": _first,
    "step": _step,
    "last": _last,
    "least_squares": _least_squares,
}


def _compiled() -> Any:
    """`newton.search_all` over compiled copies of all that it calls."""
    import math

    space: dict[str, Any] = {"sqrt": math.sqrt, "atan2": math.atan2, "_call": _call, "np": np}
    space |= {name: v for name, v in vars(newton).items() if name.isupper()}
    for module in (box_step, newton):
        for name, function in vars(module).items():
            if isinstance(function, types.FunctionType) and function.__module__ == module.__name__:
                code = _MACHINE.get(name, function).__code__
                copy = types.FunctionType(code, space, name)
                copy.__module__ = __name__
                outer = name == "search_all"
                space[name] = numba.njit(cache=outer, nogil=True, error_model="numpy")(copy)
    return space["search_all"], space["skewness"]


search_all, _skewness = _compiled()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def search_one(
    k: Any, m: int, nx: int, data: Any, c: Any, lower: Any, upper: Any, span: Any, points: Any,
    length: float, tol: float, max_iterations: int, limit: float, q: Any, report: Any,
) -> int:  # fmt: skip
    """`search_all` for one target: data holds the target (12) and the start (n).

    Returns:
        0; 1 where a number is not finite, 2 where the axes are no rotation.
    """
    n = len(span)
    for i in range(12 + n):
        if not np.isfinite(data[i]):
            return 1
    if m == 6 and not _skewness(data, 3) < limit:
        return 2
    for j in range(n):
        data[12 + j] = min(max(data[12 + j], lower[0, j]), upper[0, j])
    targets, starts = data[:12].reshape((1, 12)), data[12:].reshape((1, n))
    search_all(
        k, m, nx, targets, c, starts, lower, upper, span, points, length, tol, max_iterations,
        q, report,
    )  # fmt: skip
    return 0
