"""Newton-Raphson in the joint box, N targets at once: rows of (k, N) arrays, masks for branches.

The same search as `newton`, whose functions it shares where they hold no branch on data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from longarm_comp.core.newton import (
    DIFFERENCE,
    FIRST_DAMPING,
    FLOOR,
    NEAR,
    POOR,
    RENEW,
    STALL_AFTER,
    broyden,
    residual,
    squared,
    weighted,
)


class Machine(Protocol):
    """The model, as the search asks for it: `out` holds tip and Jacobian, (12 + 6 n, K)."""

    def step(self, q: np.ndarray, ids: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """out and the next twists, at given twists."""

    def full(self, q: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """out after all load passes, and the twists it was made with."""

    def solve(self, m: int, J: np.ndarray, e: np.ndarray, free: np.ndarray) -> np.ndarray:
        """The damped step (n, K) of `box_step.solve_damped`; free ends with the damping."""


class TracedArrays:
    """A kernel on arrays."""

    def __init__(self, kernel: Any, context: np.ndarray) -> None:
        self.kernel, self.context = kernel, context

    def _outs(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.empty((12 + 6 * len(q), q.shape[1])), np.empty((self.kernel.nx, q.shape[1]))

    def step(self, q: np.ndarray, ids: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Machine`."""
        out, y = self._outs(q)
        self.kernel.arrays[1](q, self.context[:, ids], x, out, y)
        return out, y

    def full(self, q: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Machine`."""
        out, x = self._outs(q)
        for i in range(self.kernel.passes):
            if i == 0:
                self.kernel.arrays[0](q, self.context[:, ids], x, out, x)
            else:
                x = self.step(q, ids, x)[1]
        self.kernel.arrays[2](q, self.context[:, ids], x, out, x)
        return out, x

    def solve(self, m: int, J: np.ndarray, e: np.ndarray, free: np.ndarray) -> np.ndarray:
        """See `Machine`."""
        u = np.empty((self.kernel.n, e.shape[1]))
        self.kernel.arrays[4 if m == 6 else 3](J, e, free, u, u)
        return u


@dataclass(frozen=True)
class Task:
    """What is asked of the tip, and in which box.

    Attributes:
        targets: position (m) and axes n, o, a one after the other, (12, N).
        m: 3 for position tasks, 6 for poses.
        lower, upper: joint box (n, N); a locked joint has both at its value.
        span: range of each joint (n,), the weight of its moves.
        length: metres that a radian of tool angle counts for.
        tol: on position (m) and on angle (rad).
    """

    targets: np.ndarray
    m: int
    lower: np.ndarray
    upper: np.ndarray
    span: np.ndarray
    length: float
    tol: float


def search(
    machine: Machine, task: Task, ids: np.ndarray, q: np.ndarray, max_iterations: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Search for the targets `ids` (K,), each from its own start q (n, K).

    Returns:
        Joints (n, K), position and angle residuals (2, K), iterations (K,).
    """
    state = _State(machine, task, ids, q)
    answer, left = q.copy(), np.full((2, ids.size), np.inf)
    iterations = np.zeros(ids.size, int)
    for used in range(max_iterations + 1):
        state.draw_near(used == max_iterations)
        over = state.over | (used == max_iterations)
        if over.any():
            at = state.place[over]
            answer[:, at], left[:, at] = state.q[:, over], state.size[:, over]
            iterations[at] = used
            if over.all():
                break
            state.keep(~over)
        state.iterate(used)
    return answer, left, iterations


class _State:
    """The searches that go on, each a column."""

    def __init__(self, machine: Machine, task: Task, ids: np.ndarray, q: np.ndarray) -> None:
        self.machine, self.task, self.ids, self.q = machine, task, ids, q
        self.n, count = q.shape
        self.place = np.arange(count)
        self.poor = np.zeros(count, bool)
        self.mu, self.since = np.full(count, FIRST_DAMPING), np.zeros(count, int)
        self.exact_at = np.full(count, -RENEW)
        self.sag = np.zeros((task.m * self.n, count))
        out, self.x = machine.full(q, ids)
        self.e, self.size, self.J = self.read(out, ids)
        self.energy = squared(self.e, task.m)
        self.near, self.true = np.zeros(count, bool), np.ones(count, bool)
        self.marked = self.energy.copy()

    def read(self, out: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual (6, K), its position and angle (2, K), weighted Jacobian (m n, K)."""
        task, count = self.task, ids.size
        e, size = np.zeros((6, count)), np.zeros((2, count))
        J = np.empty((task.m * self.n, count))
        residual(out, task.targets[:, ids], task.length, task.m, e, size)
        weighted(out, task.span, task.length, task.m, self.n, J)
        return e, size, J

    @property
    def over(self) -> np.ndarray:
        """Which have arrived, or gain nothing more."""
        arrived = self.true & (self.size <= self.task.tol).all(axis=0)
        return arrived | (self.since >= STALL_AFTER)

    def keep(self, which: np.ndarray) -> None:
        """Drop the other columns."""
        for name in (
            "ids",
            "place",
            "near",
            "true",
            "poor",
            "mu",
            "since",
            "energy",
            "marked",
            "exact_at",
        ):
            setattr(self, name, getattr(self, name)[which])
        for name in ("q", "x", "e", "size", "J", "sag"):
            setattr(self, name, getattr(self, name)[:, which])

    def draw_near(self, at_once: bool) -> None:
        """Close to the target, or where carried twists do not do: all load passes from here on."""
        ended = at_once | (self.since >= STALL_AFTER)
        self.near |= self.poor | (self.energy < NEAR)
        at = np.flatnonzero(~self.true & (self.poor | ended))
        if not at.size:
            return
        ids = self.ids[at]
        out = self.machine.full(self.q[:, at], ids)[0]
        self.e[:, at], self.size[:, at], self.J[:, at] = self.read(out, ids)
        self.energy[at] = squared(self.e[:, at], self.task.m)
        self.true[at], self.poor[at] = True, False

    def iterate(self, used: int) -> None:
        """One step of every search."""
        task, m, n = self.task, self.task.m, self.n
        at = np.flatnonzero(self.near & self.poor & (used >= self.exact_at + RENEW))
        if at.size:
            self.exact_at[at] = used
            self.sag[:, at] = self.differences(at) - self.J[:, at]
        damping = self.mu * np.sqrt(self.energy) + FLOOR
        low, high = task.lower[:, self.ids], task.upper[:, self.ids]
        J = self.J + self.sag
        trial = box_step(self.machine, J, self.e, self.q, low, high, task.span, damping, m)
        e2, size2, J2 = np.zeros_like(self.e), np.zeros_like(self.size), np.empty_like(self.J)
        near, far = np.flatnonzero(self.near), np.flatnonzero(~self.near)
        if near.size:
            out = self.machine.full(trial[:, near], self.ids[near])[0]
            e2[:, near], size2[:, near], J2[:, near] = self.read(out, self.ids[near])
        if far.size:
            out, self.x[:, far] = self.machine.step(trial[:, far], self.ids[far], self.x[:, far])
            e2[:, far], size2[:, far], J2[:, far] = self.read(out, self.ids[far])
        energy2 = squared(e2, m)
        learn = np.flatnonzero(self.true & self.near & (self.exact_at < used))
        if learn.size:
            u = (trial[:, learn] - self.q[:, learn]) / task.span[:, None]
            sag = self.sag[:, learn]
            broyden(self.J[:, learn], self.e[:, learn], e2[:, learn], u, m, n, sag)
            self.sag[:, learn] = sag
        crossing = self.near & ~self.true & (energy2 < NEAR)
        better = (energy2 < self.energy) | crossing
        self.poor = ((energy2 > POOR * self.energy) & (used >= 2) & ~crossing) | ~better
        for name, value in (("q", trial), ("e", e2), ("J", J2), ("size", size2)):
            setattr(self, name, np.where(better, value, getattr(self, name)))
        self.energy = np.where(better, energy2, self.energy)
        self.true = np.where(better, self.near, self.true)
        self.mu = np.where(
            better, np.maximum(0.1 * self.mu, 1e-6), np.minimum(8.0 * self.mu + 1e-3, 1e6)
        )
        moved = self.energy < 0.8 * self.marked
        self.marked = np.where(moved, self.energy, self.marked)
        self.since = np.where(moved, 0, self.since + 1)

    def differences(self, at: np.ndarray) -> np.ndarray:
        """Jacobian (m n, K) by forward differences inside the box."""
        task, m, n, ids = self.task, self.task.m, self.n, self.ids[at]
        J = np.empty((m * n, at.size))
        for j, span in enumerate(task.span):
            moved = self.q[:, at].copy()
            outside = moved[j] + DIFFERENCE * span > task.upper[j, ids]
            h = np.where(outside, -DIFFERENCE, DIFFERENCE)
            moved[j] += h * span
            e = self.read(self.machine.full(moved, ids)[0], ids)[0]
            J[j::n] = (self.e[:m, at] - e[:m]) / h
        return J


def box_step(
    machine: Machine,
    J: np.ndarray,
    e: np.ndarray,
    q: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    span: Sequence[float] | np.ndarray,
    damping: np.ndarray,
    m: int,
) -> np.ndarray:
    """Joints (n, K) after a damped least-squares step that stays in the box.

    A joint that would leave is put on its limit and the rest solved again, the furthest
    out first: at most n times.  Every joint is free again at the next iteration.
    """
    n, count = q.shape
    spans = np.asarray(span)[:, None]
    free = np.concatenate([upper > lower, damping[None]])
    left, trial = e[:m].copy(), q.copy()
    todo = np.arange(count)
    for _ in range(n):
        u = machine.solve(m, J[:, todo], left[:, todo], free[:, todo])
        f = free[:n, todo]
        moved = q[:, todo] + u * spans
        trial[:, todo] = np.where(f == 1.0, moved, trial[:, todo])
        low, high = lower[:, todo], upper[:, todo]
        by = np.maximum(low - moved, moved - high) / spans * f
        worst = by.argmax(axis=0)
        out = np.flatnonzero(by[worst, np.arange(todo.size)] > 0)
        if not out.size:
            break
        j, to = worst[out], todo[out]
        put = np.where(moved[j, out] < low[j, out], low[j, out], high[j, out])
        trial[j, to], free[j, to] = put, 0.0
        step = (put - q[j, to]) / spans[j, 0]
        for i in range(m):
            left[i, to] -= J[i * n + j, to] * step
        todo = to
    return np.clip(trial, lower, upper)
