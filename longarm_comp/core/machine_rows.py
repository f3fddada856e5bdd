"""A kernel's machine code over many targets, called through ctypes: no numba needed."""

from __future__ import annotations

import ctypes

import numpy as np

from longarm_comp.core.kernel import NAMES, Kernel


class MachineRows:
    """`newton_batch.Machine` in machine code; context: rows (N, columns)."""

    def __init__(self, kernel: Kernel, context: np.ndarray) -> None:
        self.kernel, self.context = kernel, context
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 6)
        self.calls = {name: kind(kernel.code.address(f"many_{name}")) for name in NAMES}

    def _call(self, name: str, *rows: np.ndarray) -> None:
        sizes = np.array([len(rows[0]), *(r.shape[1] for r in rows)], dtype=np.int64)
        self.calls[name](sizes.ctypes.data, *(r.ctypes.data for r in rows))

    def _rows(self, q: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, ...]:
        n, count = q.shape
        return np.ascontiguousarray(q.T), self.context[ids], np.empty((count, 12 + 6 * n))

    def step(self, q: np.ndarray, ids: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Machine`."""
        rows, context, out = self._rows(q, ids)
        y = np.ascontiguousarray(x.T)
        self._call("step", rows, context, y, out, y)
        return np.ascontiguousarray(out.T), y.T

    def full(self, q: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Machine`."""
        rows, context, out = self._rows(q, ids)
        x = np.empty((len(rows), self.kernel.nx))
        for i in range(self.kernel.passes):
            self._call("step" if i else "first", rows, context, x, out, x)
        self._call("last", rows, context, x, out, x)
        return np.ascontiguousarray(out.T), x.T

    def solve(self, m: int, J: np.ndarray, e: np.ndarray, free: np.ndarray) -> np.ndarray:
        """See `Machine`."""
        given = [np.ascontiguousarray(a.T) for a in (J, e, free)]
        u = np.empty((len(given[1]), self.kernel.n))
        self._call("solve6" if m == 6 else "solve3", *given, u, u)
        return np.ascontiguousarray(u.T)
