"""Newton-Raphson in the joint box, N targets at once: rows of (k, N) arrays, masks for branches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.box_step import rotation_error, solve_damped

# q (n, K), which targets (K,) -> tip position (3, K), axes n o a (9, K), Jacobian (6, n, K)
Evaluate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

FLOOR = 1e-13  # least damping, in units of (m per joint range)^2
DIFFERENCE = 1e-6  # step of the differences, in ranges
POOR = 0.1  # of the squared residual left after a step: then the Jacobian is made exact
STALL_AFTER = 6  # iterations without a tenth of progress that end a start


@dataclass
class Batch:
    """Where N searches stand: joints (n, N) and residuals (N,)."""

    q: np.ndarray
    position: np.ndarray
    angle: np.ndarray
    iterations: np.ndarray


@dataclass(frozen=True)
class Task:
    """What is asked of the tip, and in which box.

    Attributes:
        position: (3, N), m.
        axes: n, o, a one after the other (9, N), or None for position-only tasks.
        lower, upper: joint box (n, N); a locked joint has both at its value.
        span: range of each joint (n,), the weight of its moves.
        length: metres that a radian of tool angle counts for.
        tol: on position (m) and on angle (rad).
    """

    position: np.ndarray
    axes: np.ndarray | None
    lower: np.ndarray
    upper: np.ndarray
    span: np.ndarray
    length: float
    tol: float

    @property
    def m(self) -> int:
        """Number of equations."""
        return 3 if self.axes is None else 6


def search(evaluate: Evaluate, task: Task, q0: np.ndarray, max_iterations: int) -> Batch:
    """Levenberg-Marquardt with an active set, every target from its own start q0 (n, N)."""
    count = q0.shape[1]
    ids = np.arange(count)
    state = Batch(q0.copy(), np.full(count, np.inf), np.full(count, np.inf), np.zeros(count, int))
    q, (e, position, angle, J) = q0, _residual(evaluate, task, q0, ids)
    energy = (e * e).sum(0)
    mu = np.full(count, 0.05)
    marked, since = energy.copy(), np.zeros(count, int)
    state.position[:], state.angle[:] = position, angle
    sag, poor = np.zeros_like(J), np.zeros(count, bool)  # exact less geometric Jacobian; wanted
    for _ in range(max_iterations):
        go = ((position > task.tol) | (angle > task.tol)) & (since < STALL_AFTER)
        if not go.all():
            ids, q, e, J = ids[go], q[:, go], e[:, go], J[..., go]
            sag, poor = sag[..., go], poor[go]
            energy, mu, marked, since = energy[go], mu[go], marked[go], since[go]
            position, angle = position[go], angle[go]
        if not ids.size:
            break
        if poor.any():
            at = np.flatnonzero(poor)
            sag[..., at] = differences(evaluate, task, q[:, at], e[:, at], ids[at]) - J[..., at]
        u = box_step(task, J + sag, e, q, ids, mu * energy + FLOOR)
        trial = np.clip(q + u * task.span[:, None], task.lower[:, ids], task.upper[:, ids])
        e2, position2, angle2, J2 = _residual(evaluate, task, trial, ids)
        energy2 = (e2 * e2).sum(0)
        better = energy2 < energy
        poor = energy2 > POOR * energy
        q, e, J = np.where(better, trial, q), np.where(better, e2, e), np.where(better, J2, J)
        position, angle = np.where(better, position2, position), np.where(better, angle2, angle)
        energy = np.where(better, energy2, energy)
        mu = np.where(better, np.maximum(0.1 * mu, 1e-6), np.minimum(8 * mu + 1e-3, 1e6))
        moved = energy < 0.8 * marked
        marked, since = np.where(moved, energy, marked), np.where(moved, 0, since + 1)
        state.q[:, ids], state.position[ids], state.angle[ids] = q, position, angle
        state.iterations[ids] += 1
    return state


def box_step(
    task: Task, J: np.ndarray, e: np.ndarray, q: np.ndarray, ids: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Damped least-squares step (n, K) in units of range, q + step inside the box.

    A joint that would leave is put on its limit and the rest solved again, the furthest
    out first: at most n times.  Every joint is free again at the next iteration.
    """
    m, (n, count) = task.m, q.shape
    span = task.span[:, None]
    low, high = (task.lower[:, ids] - q) / span, (task.upper[:, ids] - q) / span
    Jw = (J * task.span[:, None]).reshape(m * n, count).copy()
    free = (high > low).astype(float)
    held = np.zeros((n, count))
    step = np.empty((n, count))
    todo = np.arange(count)
    for _ in range(n):
        f, h, Jt = free[:, todo], held[:, todo], Jw[:, todo]
        left = e[:, todo] - np.einsum("mnk,nk->mk", Jt.reshape(m, n, -1), h)
        A, y, u = np.empty((m * m, todo.size)), np.empty((m, todo.size)), np.empty((n, todo.size))
        solve_damped(Jt, left, f, damping[todo], m, n, A, y, u)
        step[:, todo] = u + h
        out = np.maximum(low[:, todo] - u, u - high[:, todo]) * f
        worst = out.argmax(0)
        k = np.arange(todo.size)
        violated = out[worst, k] > 0
        if not violated.any():
            break
        todo, worst = todo[violated], worst[violated]
        uw = u[worst, k[violated]]
        held[worst, todo] = np.where(uw < low[worst, todo], low[worst, todo], high[worst, todo])
        free[worst, todo] = 0.0
    return step


def differences(
    evaluate: Evaluate, task: Task, q: np.ndarray, e: np.ndarray, ids: np.ndarray
) -> np.ndarray:
    """Jacobian (m, n, K) by forward differences inside the box: how the sag moves is in it."""
    J = np.empty((task.m, *q.shape))
    for k, span in enumerate(task.span):
        h = np.where(q[k] + DIFFERENCE * span > task.upper[k, ids], -1.0, 1.0) * DIFFERENCE * span
        moved = q.copy()
        moved[k] += h
        J[:, k] = (e - _residual(evaluate, task, moved, ids)[0]) / h
    return J


def _residual(
    evaluate: Evaluate, task: Task, q: np.ndarray, ids: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weighted residual (m, K), position (m) and angle (rad) residuals (K,), Jacobian (6, n, K)."""
    p, axes, J = evaluate(q, ids)
    e = np.empty((task.m, ids.size))
    e[:3] = task.position[:, ids] - p
    position = np.sqrt((e[:3] * e[:3]).sum(0))
    angle = np.zeros(ids.size)
    if task.axes is not None:
        angle = rotation_error(axes, 0, task.axes[:, ids], 0, e, 3)
        e[3:] *= task.length
        J = np.concatenate([J[:3], J[3:] * task.length])
    return e, position, angle, J[: task.m]
