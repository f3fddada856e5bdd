"""Nearest points of a lattice: LLL reduction and Schnorr-Euchner enumeration.

C. P. Schnorr and M. Euchner, Lattice basis reduction: improved practical algorithms and solving
subset sum problems, Mathematical Programming 66 (1994).
"""

import bisect
import math

import numpy as np

EDGE = 1e-9
"""Share of a step by which rounding may put a point beyond the box."""


def nearest(
    R: np.ndarray, low: np.ndarray, high: np.ndarray, *, kept: int = 16, max_nodes: int = 4000
) -> tuple[np.ndarray, int]:
    """Find at most `kept` points ``R k + y`` nearest to zero, for integers k in a box.

    The search radius is the one whose ball holds twice `kept` points on average (its volume over
    that of a cell); it grows if too few of them are in the box.

    Args:
        R: (n, n + 1): an upper triangular matrix without zeros on its diagonal; y is the last
            column.
        low, high: (n,) integers, the box of k.
        max_nodes: number of nodes after which a search ends with the points found so far.

    Returns:
        k (P, n), the nearest first, and the number of visited nodes of the search tree.
    """
    tree = _Tree(R, low, high, kept, max_nodes)
    for _ in range(8):
        tree.visit(tree.n - 1, 0.0, -tree.W @ tree.R[:, tree.n])
        if len(tree.best) == kept or tree.nodes >= max_nodes:
            break
        tree.seen2, tree.radius2 = tree.radius2, 2.0 * tree.radius2
    return np.array([k for _, k in tree.best]).reshape(-1, len(low)), tree.nodes


class _Tree:
    """Depth-first search of one lattice; level n - 1 is the root."""

    def __init__(
        self, R: np.ndarray, low: np.ndarray, high: np.ndarray, kept: int, max_nodes: int
    ) -> None:
        n = self.n = len(R)
        self.low, self.high, self.kept, self.max_nodes = low, high, kept, max_nodes
        self.R, self.U = _reduce(R)
        # k = W (residual - y): a branch is cut off if the levels below cannot bring k into the box
        self.W = self.U @ np.linalg.inv(self.R[:, :n])
        self.spread2 = np.cumsum(self.W**2, axis=1)
        ball = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
        log_cell = np.log(np.abs(np.diagonal(R))).sum()
        self.radius2 = math.exp((math.log(2.0 * kept / ball) + log_cell) * (2.0 / n))
        self.seen2 = 0.0  # points within are in the list already
        self.z = np.zeros(n)
        self.best: list[tuple[float, np.ndarray]] = []
        self.nodes = 0

    def visit(self, level: int, total: float, expected: np.ndarray) -> None:
        """Try the integers at a level, from the centre outwards, then the levels below."""
        reach2 = (self.radius2 - total) * self.spread2[:, level]
        gap = np.maximum(np.maximum(self.low - expected, expected - self.high) - EDGE, 0.0)
        if (gap * gap > reach2).any():
            return
        row, n = self.R[level], self.n
        centre = -(row[n] + row[level + 1 : n] @ self.z[level + 1 :]) / row[level]
        z = math.floor(centre + 0.5)
        side = -1 if centre < z else 1
        while self.nodes < self.max_nodes:
            left = row[level] * (z - centre)
            if total + left * left >= self.radius2:
                return
            self.nodes += 1
            self.z[level] = z
            if level:
                self.visit(level - 1, total + left * left, expected + self.W[:, level] * left)
            else:
                self._leaf(total + left * left)
            z += side
            side = -side - (1 if side > 0 else -1)

    def _leaf(self, distance2: float) -> None:
        """Insert the present point into the list if it is in the box.

        The worst point of a full list sets the search radius.
        """
        k = np.rint(self.U @ self.z)
        if distance2 < self.seen2 or (k < self.low).any() or (k > self.high).any():
            return
        bisect.insort(self.best, (distance2, k), key=lambda entry: entry[0])
        del self.best[self.kept :]
        if len(self.best) == self.kept:
            self.radius2 = min(self.radius2, self.best[-1][0])


def _reduce(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce an upper triangular R (n, n + 1) by LLL; return it and the integer matrix U (n, n).

    The reduced first n columns are those of ``R[:, :n] U``, up to a rotation of all columns.
    """
    n = len(R)
    R, U = R.copy(), np.eye(n)
    b = 1
    while b < n:
        for a in range(b - 1, -1, -1):
            times = np.floor(R[a, b] / R[a, a] + 0.5)
            R[:, b] -= times * R[:, a]
            U[:, b] -= times * U[:, a]
        a = b - 1
        if R[a, b] ** 2 + R[b, b] ** 2 >= 0.99 * R[a, a] ** 2:
            b += 1
            continue
        for matrix in (R, U):
            matrix[:, [a, b]] = matrix[:, [b, a]]
        p, q = R[a, a], R[b, a]
        size = math.hypot(p, q)
        R[[a, b]] = np.array([[p, q], [-q, p]]) / size @ R[[a, b]]
        R[b, a] = 0.0
        b = max(a, 1)
    return R, U
