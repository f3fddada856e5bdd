"""Inverse kinematics of the deflected arm: Newton-Raphson on any model, inside the joint box.

Solved for the *true* tip: what the camera reports wrongly is never compensated.  The seed
comes first and restarts follow only where it fails, so that a tracked path does not jump to
another branch.  Limits hold exactly; success is judged on the joints handed out, with the
model's full load passes; a failure is an answer with the best joints and the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial

import numpy as np

from longarm_comp.core.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.jacobian import geometric
from longarm_comp.core.model import Model
from longarm_comp.core.newton_batch import Batch, Evaluate, Task, search
from longarm_comp.core.spatial import Frame

TOLERANCE = 1e-9
MAX_ITERATIONS = 60
MAX_STARTS = 16
_RADII = (0.25, 0.5)  # of the joint box about the seed, for the first restarts
_CHUNK = 1024


class Reason(Enum):
    """Why a search ended."""

    CONVERGED = "converged"
    AT_LIMITS = "joint limits keep the tip from the target"
    OUT_OF_REACH = "no joints bring the tip nearer to the target"
    ITERATIONS = "the permitted iterations are used up"


@dataclass(frozen=True, slots=True)
class Solution:
    """Joints for one target.

    Attributes:
        q: (n,), inside the limits; the best found when not `ok`.
        ok: residuals are within the tolerance.
        reason: why the search ended.
        position_residual_m, angle_residual_rad: what is left at q (0 rad for position tasks).
        iterations: in total, over all starts.
        active_limits: names of the joints that stand on a limit.
        starts: how many starts were tried; 1 means that the seed led there.
    """

    q: np.ndarray
    ok: bool
    reason: Reason
    position_residual_m: float
    angle_residual_rad: float
    iterations: int
    active_limits: tuple[str, ...]
    starts: int


@dataclass(frozen=True)
class Solutions:
    """Joints for N targets; the fields of `Solution` as arrays. Index it for one `Solution`."""

    q: np.ndarray
    ok: np.ndarray
    reason: tuple[Reason, ...]
    position_residual_m: np.ndarray
    angle_residual_rad: np.ndarray
    iterations: np.ndarray
    at_limit: np.ndarray
    starts: np.ndarray
    joint_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, i: int) -> Solution:
        names = tuple(n for n, at in zip(self.joint_names, self.at_limit[i], strict=True) if at)
        return Solution(
            self.q[i],
            bool(self.ok[i]),
            self.reason[i],
            float(self.position_residual_m[i]),
            float(self.angle_residual_rad[i]),
            int(self.iterations[i]),
            names,
            int(self.starts[i]),
        )


def solve(
    model: Model,
    target: np.ndarray | Frame,
    *,
    seed: np.ndarray | None = None,
    context: Context | None = None,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    tol: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
    max_starts: int = MAX_STARTS,
    rng: np.random.Generator | None = None,
) -> Solution:
    """Joints that bring the tip to one target: see `solve_many`.

    Args:
        target: position (3,) in m, or pose (4, 4) or `Frame`, base frame.
        seed: (n,) start, best the current joints; the middle of the box by default.
    """
    if isinstance(target, Frame):
        target = target.matrix()
    target = np.asarray(target, dtype=float)
    if target.shape not in ((3,), (4, 4)):
        raise InputError("ik.solve", "target", f"shape {target.shape}", "shape (3,) or (4, 4)")
    many = solve_many(
        model,
        target[None],
        seed=seed,
        context=context,
        position_only=position_only,
        locked=locked,
        tol=tol,
        max_iterations=max_iterations,
        max_starts=max_starts,
        rng=rng,
    )
    return many[0]


def solve_many(
    model: Model,
    targets: np.ndarray,
    *,
    seed: np.ndarray | None = None,
    context: Context | None = None,
    position_only: bool = False,
    locked: Sequence[int | str] = (),
    tol: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
    max_starts: int = MAX_STARTS,
    rng: np.random.Generator | None = None,
) -> Solutions:
    """Joints that bring the tip to each of N targets.

    Args:
        model: arm and effects; its camera-side biases play no part.
        targets: positions (N, 3) in m or poses (N, 4, 4), base frame.
        seed: (n,) or (N, n) starts (rad, m), put inside the limits; default mid-range.
        context: circumstances of the targets, scalars or (N,) arrays.
        position_only: leave the orientation free (always so for (N, 3)).
        locked: joints that stay at their seed: 0-based numbers in q, or names.
        tol: on the position (m) and on the angle (rad).
        max_iterations: per start.
        max_starts: the seed and so many restarts less one; 1 never leaves the seed's branch.
        rng: draws the restarts; by default a fixed low-discrepancy sequence does.

    Raises:
        InputError: wrong shape, numbers that are not finite, no rotation, unknown joint.
    """
    arm = model.arm
    position, axes = checked_targets(targets, position_only)
    start = checked_seed(model, seed, len(position))
    if not (np.isfinite(tol) and tol > 0):
        raise InputError("ik.solve_many", "tol", tol, "a number above 0")
    lower = np.repeat(arm.lower[:, None], len(position), axis=1)
    upper = np.repeat(arm.upper[:, None], len(position), axis=1)
    for k in locked_joints(model, locked):
        lower[k] = upper[k] = start[:, k]
    length = characteristic_length(model)
    context = context or Context.empty()
    parts = []
    for first in range(0, len(position), _CHUNK):
        rows = slice(first, first + _CHUNK)
        task = Task(
            np.ascontiguousarray(position[rows].T),
            None if axes is None else np.ascontiguousarray(axes[rows].T),
            lower[:, rows],
            upper[:, rows],
            arm.upper - arm.lower,
            length,
            tol,
        )
        evaluate = _evaluator(model, context.take(np.arange(len(position))[rows]))
        parts.append(_restarted(evaluate, task, start[rows].T, max_iterations, max_starts, rng))
    return _collect(model, parts, tol, max_iterations)


def characteristic_length(model: Model) -> float:
    """Metres that a radian of tool angle counts for: a quarter of the stretched arm."""
    size = sum(abs(j.a_m) + abs(j.d_m) for j in model.arm.joints)
    return max(0.25 * size, 0.01)


def target_faults(targets: np.ndarray, position_only: bool, where: str) -> list[str]:
    """What is wrong with each of N targets; an empty string where nothing is.

    Raises:
        InputError: the targets are neither (N, 3) nor (N, 4, 4).
    """
    if targets.ndim not in (2, 3) or targets.shape[1:] not in ((3,), (4, 4)):
        allowed = "shape (N, 3) or (N, 4, 4)"
        raise InputError(where, "targets", f"shape {targets.shape}", allowed)
    finite = np.isfinite(targets).reshape(len(targets), -1).all(axis=1)
    turned = np.ones(len(targets), bool)
    if targets.ndim == 3 and not position_only:
        T = np.where(finite[:, None, None], targets, 0.0)
        R = T[:, :3, :3]
        off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
        turned = (off < 1e-6) & (np.linalg.det(R) > 0) & (T[:, 3] == [0, 0, 0, 1]).all(axis=1)
    return [
        ("" if t else "its orientation is no rotation") if f else "it holds a number not finite"
        for f, t in zip(finite, turned, strict=True)
    ]


def checked_targets(
    targets: np.ndarray, position_only: bool, where: str = "ik.solve_many"
) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (N, 3) and axes n, o, a (N, 9) or None, checked at the door."""
    targets = np.asarray(targets, dtype=float)
    for i, fault in enumerate(target_faults(targets, position_only, where)):
        if fault:
            allowed = f"finite numbers in m, a rotation and [0, 0, 0, 1]: {fault}"
            raise InputError(where, f"target {i}", targets[i].tolist(), allowed)
    if targets.ndim == 2:
        return targets, None
    axes = targets[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)
    return targets[:, :3, 3], None if position_only else axes


def checked_seed(
    model: Model, seed: np.ndarray | None, count: int, where: str = "ik.solve_many"
) -> np.ndarray:
    """Starts (N, n), inside the limits."""
    arm = model.arm
    given = np.asarray(arm.mid if seed is None else seed, dtype=float)
    if given.shape not in ((arm.n,), (count, arm.n)):
        allowed = f"shape ({arm.n},) or ({count}, {arm.n})"
        raise InputError(where, "seed", f"shape {given.shape}", allowed)
    if not np.isfinite(given).all():
        raise InputError(where, "seed", given, "finite joint values")
    return np.clip(np.broadcast_to(given, (count, arm.n)), arm.lower, arm.upper)


def locked_joints(model: Model, locked: Sequence[int | str]) -> list[int]:
    """0-based numbers in q of joints given by number or name."""
    names = model.arm.joint_names
    made = []
    for joint in locked:
        if isinstance(joint, str) and joint in names:
            made.append(names.index(joint))
        elif isinstance(joint, int) and 0 <= joint < model.arm.n:
            made.append(joint)
        else:
            allowed = f"0..{model.arm.n - 1} or one of {', '.join(names)}"
            raise InputError("ik.solve_many", "locked", joint, allowed)
    return made


def _evaluator(model: Model, context: Context) -> Evaluate:
    """The model, as the search asks for it."""

    def evaluate(q: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        posture = model.posture(tuple(q), context.take(ids))
        tip = model.tip_frame(posture)
        shape = (6, len(q), ids.size)
        J = np.empty(shape)
        for k, (linear, angular) in enumerate(geometric(posture, tip.p)):
            for i, value in enumerate((*linear, *angular)):
                J[i, k] = value
        p, axes = np.empty((3, ids.size)), np.empty((9, ids.size))
        for i in range(3):
            p[i] = tip.p[i]
            axes[i], axes[3 + i], axes[6 + i] = tip.n[i], tip.o[i], tip.a[i]
        return p, axes, J

    return evaluate


def _restarted(
    evaluate: Evaluate,
    task: Task,
    start: np.ndarray,
    max_iterations: int,
    max_starts: int,
    rng: np.random.Generator | None,
) -> tuple[Batch, Task, np.ndarray]:
    """Search from the seed, then again from elsewhere for those that failed."""
    best = search(evaluate, task, start, max_iterations)
    starts = np.ones(start.shape[1], int)
    draws = restart_points(len(start), max_starts - 1, rng)
    for k, point in enumerate(draws):
        failed = np.flatnonzero((best.position > task.tol) | (best.angle > task.tol))
        if not failed.size:
            break
        sub = Task(
            task.position[:, failed],
            None if task.axes is None else task.axes[:, failed],
            task.lower[:, failed],
            task.upper[:, failed],
            task.span,
            task.length,
            task.tol,
        )
        box = sub.upper - sub.lower
        radius = _RADII[k] if k < len(_RADII) else 1.0
        centre = (1 - radius) * start[:, failed] + radius * (sub.lower + 0.5 * box)
        q0 = centre + radius * (point[:, None] - 0.5) * box
        q0 = np.clip(q0, sub.lower, sub.upper)
        found = search(partial(_among, evaluate, failed), sub, q0, max_iterations)
        score = np.hypot(found.position, task.length * found.angle)
        held = np.hypot(best.position[failed], task.length * best.angle[failed])
        won = score < held
        to = failed[won]
        best.q[:, to], best.position[to] = found.q[:, won], found.position[won]
        best.angle[to] = found.angle[won]
        best.iterations[failed] += found.iterations
        starts[failed] += 1
    return best, task, starts


def _among(
    evaluate: Evaluate, some: np.ndarray, q: np.ndarray, ids: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return evaluate(q, some[ids])


def restart_points(n: int, count: int, rng: np.random.Generator | None) -> np.ndarray:
    """(count, n) points in the unit box: drawn, or the additive recurrence of the plastic number's
    generalisation (M. Roberts' R_d sequence), which is the same every time."""
    if rng is not None:
        return rng.random((max(count, 0), n))
    g = 2.0
    for _ in range(40):
        g = (1 + g) ** (1 / (n + 1))
    steps = (1 / g) ** np.arange(1, n + 1)
    return (0.5 + np.arange(1, max(count, 0) + 1)[:, None] * steps) % 1.0


def _collect(
    model: Model, parts: list[tuple[Batch, Task, np.ndarray]], tol: float, max_iterations: int
) -> Solutions:
    n = model.arm.n
    if not parts:
        none = np.zeros(0)
        flags = np.zeros((0, n), bool)
        whole = np.zeros(0, int)
        names = model.arm.joint_names
        return Solutions(np.zeros((0, n)), none > 0, (), none, none, whole, flags, whole, names)
    q = np.concatenate([b.q.T for b, _, _ in parts])
    position = np.concatenate([b.position for b, _, _ in parts])
    angle = np.concatenate([b.angle for b, _, _ in parts])
    iterations = np.concatenate([b.iterations for b, _, _ in parts])
    starts = np.concatenate([s for _, _, s in parts])
    at_limit = (q <= model.arm.lower) | (q >= model.arm.upper)
    ok = (position <= tol) & (angle <= tol)
    reasons = []
    for i in range(len(q)):
        if ok[i]:
            reasons.append(Reason.CONVERGED)
        elif iterations[i] >= starts[i] * max_iterations:
            reasons.append(Reason.ITERATIONS)
        else:
            reasons.append(Reason.AT_LIMITS if at_limit[i].any() else Reason.OUT_OF_REACH)
    return Solutions(
        q, ok, tuple(reasons), position, angle, iterations, at_limit, starts, model.arm.joint_names
    )
