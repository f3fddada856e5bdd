"""One damped least-squares step inside a box: the linear algebra of the inverse kinematics.

The functions work on flat buffers and have no branch on data.  The same code therefore serves
floats, arrays whose entries are (N,) slices, and traced numbers.
"""

from __future__ import annotations

from typing import Any

from longarm_comp.core.arm.spatial import atan2, sqrt

_Buffer = Any  # list of floats, (k,) array, or (k, N) array


def solve_damped(
    J: _Buffer, e: _Buffer, free: _Buffer, damping: Any, m: int, n: int,
    A: _Buffer, y: _Buffer, u: _Buffer,
) -> None:  # fmt: skip
    """Smallest u with ``J F u = e`` in the damped sense: ``u = F J' (J F J' + damping 1)^-1 e``.

    Args:
        J, e: m x n, row after row; m.
        free: n; 1 where an unknown is free, 0 where it is held (F is its diagonal).
        damping: above 0, so that the Cholesky factor exists.
        A, y: m x m, m, work; A keeps the factor (below the diagonal) and the inverse pivots.
        u: n, the result.
    """
    for i in range(m):
        for j in range(i + 1):
            s = (J[j * n] * free[0]) * J[i * n]
            for k in range(1, n):
                s = s + (J[j * n + k] * free[k]) * J[i * n + k]
            A[i * m + j] = s
        A[i * m + i] = A[i * m + i] + damping
    for j in range(m):  # A = L D L'
        pivot = A[j * m + j]
        for k in range(j):
            pivot = pivot - A[j * m + k] * A[j * m + k] * A[k * m + k]
        A[j * m + j] = pivot
        for i in range(j + 1, m):
            s = A[i * m + j]
            for k in range(j):
                s = s - A[i * m + k] * A[j * m + k] * A[k * m + k]
            A[i * m + j] = s / pivot
    for i in range(m):
        s = e[i]
        for k in range(i):
            s = s - A[i * m + k] * y[k]
        y[i] = s
    for i in range(m - 1, -1, -1):
        s = y[i] / A[i * m + i]
        for k in range(i + 1, m):
            s = s - A[k * m + i] * y[k]
        y[i] = s
    for k in range(n):
        s = J[k] * y[0]
        for i in range(1, m):
            s = s + J[i * n + k] * y[i]
        u[k] = s * free[k]


def rotation_error(R: _Buffer, r: int, target: _Buffer, t: int, e: _Buffer, at: int) -> Any:
    """Rotation vector (rad, base frame) from R to the target, written to ``e[at:at+3]``.

    Both hold axes n, o, a one after the other, 9 numbers each, from index r and t on.  Returns the
    angle (rad), 0 to pi.  At pi the vector is 0, as its direction is undefined.
    """
    x = y = z = trace = 0.0  # sum of the cross products of the axes, and of their scalar products
    for k in (0, 3, 6):
        a0, a1, a2 = R[r + k], R[r + k + 1], R[r + k + 2]
        b0, b1, b2 = target[t + k], target[t + k + 1], target[t + k + 2]
        x = x + (a1 * b2 - a2 * b1)
        y = y + (a2 * b0 - a0 * b2)
        z = z + (a0 * b1 - a1 * b0)
        trace = trace + (a0 * b0 + a1 * b1 + a2 * b2)
    x, y, z = 0.5 * x, 0.5 * y, 0.5 * z
    s = sqrt(x * x + y * y + z * z)
    angle = atan2(s, 0.5 * (trace - 1.0))
    ratio = angle / (s + 1e-300)
    e[at], e[at + 1], e[at + 2] = ratio * x, ratio * y, ratio * z
    return angle


def skewness(R: _Buffer, r: int) -> Any:
    """How far the axes n, o, a (9 numbers from index r on) are from a right-handed rotation: sum
    of the squares of ``R'R - 1`` (once each) and of ``n x o - a``."""
    s = 0.0
    for i in range(3):
        for j in range(i + 1):
            d = R[r + 3 * i] * R[r + 3 * j]
            d = d + R[r + 3 * i + 1] * R[r + 3 * j + 1] + R[r + 3 * i + 2] * R[r + 3 * j + 2]
            if i == j:
                d = d - 1.0
            s = s + d * d
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        d = R[r + j] * R[r + 3 + k] - R[r + k] * R[r + 3 + j] - R[r + 6 + i]
        s = s + d * d
    return s
