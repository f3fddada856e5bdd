"""`newton`, compiled: the same functions with the machine's five replaced.

The loop knows kernels by address only, so it is compiled once for all models and kept in
numba's cache (some 10 s the first time, well under a second later).
"""

from __future__ import annotations

import hashlib
import types
from pathlib import Path
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
                space[name] = numba.njit(nogil=True, error_model="numpy")(copy)
    return space["search_all"], space["skewness"]


def _version() -> int:
    """A number that changes with the sources that are compiled in: numba's cache watches only
    the file of the outermost function."""
    text = b"".join(Path(str(module.__file__)).read_bytes() for module in (box_step, newton))
    return int(hashlib.sha256(text).hexdigest()[:12], 16)


_search_all, _skewness = _compiled()


_double, _integer = nb.CPointer(nb.float64), nb.CPointer(nb.intp)  # type: ignore[attr-defined]


def _entries(version: int) -> tuple[Any, Any]:
    """The two functions that are called from outside; `version` is part of their cache's key."""

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def search_all(
        k: Any, m: int, nx: int, targets: Any, contexts: Any, starts: Any, lower: Any,
        upper: Any, span: Any, points: Any, length: float, tol: float, max_iterations: int,
        q: Any, report: Any,
    ) -> None:  # fmt: skip
        """`newton.search_all`."""
        if version >= 0:
            _search_all(
                k, m, nx, targets, contexts, starts, lower, upper, span, points, length, tol,
                max_iterations, q, report,
            )  # fmt: skip

    @numba.cfunc(nb.void(_integer, _double, _double), cache=True, error_model="numpy")
    def search_one(numbers: Any, constants: Any, data: Any) -> None:
        """`search_all` for one target, called by address.

        Args:
            numbers: programs and passes (6), m, nx, n, context columns, restarts, iterations.
            constants: length, tol, tolerance of rotations, then lower, upper, span, restarts.
            data: target (4 x 4, or a position in its last column), start, context; then the
                answer: joints, report (4), and 1 where a number is not finite, 2 where the
                orientation is no rotation.
        """
        if version < 0:
            return
        i = numba.carray(numbers, 12)
        m, nx, n, nc, more = i[6], i[7], i[8], i[9], i[10]
        f = numba.carray(constants, 3 + 3 * n + more * (n + 1))
        d = numba.carray(data, 16 + n + nc + n + 5)
        fault = 16 + n + nc + n + 4
        d[fault] = 0.0
        for j in range(16 + n):
            if not np.isfinite(d[j]):
                d[fault] = 1.0
                return
        target = np.empty((1, 12))
        for j in range(3):
            target[0, j] = d[4 * j + 3]
            for k in range(3):
                target[0, 3 + 3 * j + k] = d[4 * k + j]
        if m == 6:
            whole = d[12] == 0.0 and d[13] == 0.0 and d[14] == 0.0 and d[15] == 1.0
            if not whole or not _skewness(target[0], 3) < f[2]:
                d[fault] = 2.0
                return
        at = 3
        lower, upper, span = f[at : at + n], f[at + n : at + 2 * n], f[at + 2 * n : at + 3 * n]
        points = f[at + 3 * n : at + 3 * n + more * (n + 1)].reshape((more, n + 1))
        start = d[16 : 16 + n]
        for j in range(n):
            start[j] = min(max(start[j], lower[j]), upper[j])
        c, q = d[16 + n : 16 + n + nc], d[16 + n + nc : 16 + n + nc + n]
        report = d[fault - 4 : fault]
        report[:] = 0.0
        _search_all(
            (i[0], i[1], i[2], i[3], i[4], i[5]), m, nx, target, c.reshape((1, nc)),
            start.reshape((1, n)), lower.reshape((1, n)), upper.reshape((1, n)), span, points,
            f[0], f[1], i[11], q.reshape((1, n)), report.reshape((1, 4)),
        )  # fmt: skip

    return search_all, search_one


search_all, search_one = _entries(_version())


def by_address() -> Any:
    """`search_one` as ctypes calls it: three addresses."""
    import ctypes

    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3)(search_one.address)
