"""Inverse kinematics of the deflected arm: Newton-Raphson on any model, inside the joint box.

It is solved for the *true* tip, so errors of the camera are never compensated.  Restarts follow
only if the seed fails, so that a tracked path does not jump to another branch.  Success is
evaluated at the returned joints with all load passes of the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.spatial import Frame
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import newton
from longarm_comp.core.ik.engines import NOTHING, Engine, compile_at_once, run, tip_poses, warm_up
from longarm_comp.core.ik.kernel import Kernel, characteristic_length, kernel_of
from longarm_comp.core.ik.newton import REACHED, rotation_error, skewness
from longarm_comp.core.model.model import Model

__all__ = [
    "Engine",
    "Reason",
    "Solution",
    "Solutions",
    "compile_at_once",
    "solve",
    "solve_many",
    "warm_up",
]

# joints (n,); position (m) and angle (rad) residuals, iterations, fault
_Found = tuple[np.ndarray, list[float]]
_BOX = ("lower", "upper")


class _Workspace:
    """The state of one search: the first column of a block, with views of inputs and results."""

    def __init__(self, kernel: Kernel, options: tuple[int, float, float]) -> None:
        m, tol, length = options
        block = np.zeros((kernel.size, kernel.code.width))
        column = block[:, 0]
        column[kernel.slice("live")] = 1.0
        column[kernel.slice("tol")], column[kernel.slice("length")] = tol, length
        column[kernel.slice("permitted")] = newton.MAX_ITERATIONS
        for name, limits in zip(_BOX, kernel.arm.box_about(kernel.arm.mid), strict=True):
            block[kernel.slice(name)] = limits[:, None]
        self.kernel, self.endless = kernel, bool(np.isinf(kernel.arm.bounds[1]).any())
        self.box = [column[kernel.slice(name)] for name in _BOX]
        self.given = column[kernel.slice("given")].reshape(4, 4)
        self.position = self.given[:3, 3]
        self.seed, self.q = column[kernel.slice("seed")], column[kernel.slice("q")]
        self.context = column[kernel.slice("c")]
        self.packed: Context | None = None  # the one that is in there
        self.report = column[kernel.place["size"].start : kernel.place["fault"].stop]
        self.block = block  # keeps the memory of the views
        self.address = block.ctypes.data
        self.function = kernel.code.function(f"solve{m}")

    def search(self, target: np.ndarray, seed: np.ndarray, context: Context | None) -> _Found:
        """Search from the seed without restarts."""
        if target.size == 3:
            self.given[...] = 0.0
            self.position[...] = target
        else:
            self.given[...] = target
        self.seed[...] = seed
        if self.endless:
            self.box[0][...], self.box[1][...] = self.kernel.arm.box_about(seed)
        if context is not self.packed and context is not None:
            self.context[...] = self.kernel.layout.pack(context, 1)[0]
            self.packed = context
        self.function(self.address)
        return self.q.copy(), self.report.tolist()


def solve_compiled(
    model: Model,
    target: np.ndarray,
    seed: np.ndarray | None,
    context: Context | None,
    options: tuple[int, float, float],
    engine: Engine,
) -> _Found | None:
    """Search from a seed (default mid-range) in machine code.

    None if the request needs the general solver: the model is not compiled, a text column of the
    context has several values, or the input is invalid and needs an error message.

    Args:
        target: (3,), m, or (4, 4), base frame.
        options: number of equations, tolerance (m and rad), and weight of a radian (m).
    """
    seed = model.arm.mid if seed is None else np.asarray(seed)
    if seed.shape != (model.arm.n,):
        return None
    layout = NOTHING if context is None else context.layout
    spare: dict[Any, list[_Workspace]] = model.memo.setdefault("workspaces", {})
    free = spare.setdefault((layout, *options), [])
    try:
        workspace = free.pop()
    except IndexError:  # there is none yet, or another thread uses it
        if not layout.traceable or not options[1] > 0:
            return None
        kernel = kernel_of(model, layout)
        if engine is not Engine.COMPILED and not kernel.is_compiled:
            return None
        workspace = _Workspace(kernel, options)
    found = workspace.search(target, seed, context)
    free.append(workspace)
    return None if found[1][-1] else found


TOLERANCE = 1e-9
"""Tolerance of the search, m and rad."""
MAX_STARTS = 16
_NEAR = 1e-2
"""Factor on the weight of a radian in the first search for a pose that cannot be reached."""


class Reason(Enum):
    CONVERGED = "converged"
    AT_LIMITS = "joint limits keep the tip from the target"
    OUT_OF_REACH = "no joints bring the tip nearer to the target"
    ITERATIONS = "the search did not end within the permitted iterations"


class Solution(NamedTuple):
    """Joints for one target.

    `ok` tells whether the residuals are within the larger of `REACHED` and `tol`. If an orientation
    could only be held as `near` as possible, the position alone counts.
    """

    q: np.ndarray  # (n,), inside the limits; the best found when not `ok`
    ok: bool
    reason: Reason  # why the search ended
    position_residual_m: float  # at q
    angle_residual_rad: float  # at q; 0 for position tasks
    iterations: int  # total number over all starts
    starts: int  # number of starts; 1 means that the seed sufficed


@dataclass(frozen=True)
class Solutions:
    """Joints for N targets; the fields of `Solution` as arrays. Index it for one `Solution`."""

    q: np.ndarray
    ok: np.ndarray
    reason: tuple[Reason, ...]
    position_residual_m: np.ndarray
    angle_residual_rad: np.ndarray
    iterations: np.ndarray
    starts: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, i: int) -> Solution:
        return Solution(
            self.q[i],
            bool(self.ok[i]),
            self.reason[i],
            float(self.position_residual_m[i]),
            float(self.angle_residual_rad[i]),
            int(self.iterations[i]),
            int(self.starts[i]),
        )


def solve(
    model: Model,
    target: np.ndarray | Frame,
    *,
    seed: np.ndarray | None = None,
    context: Context | None = None,
    position_only: bool = False,
    near: bool = False,
    locked: Sequence[int | str] = (),
    tol: float = TOLERANCE,
    max_starts: int = MAX_STARTS,
    engine: Engine = Engine.AUTO,
) -> Solution:
    """Find joints that bring the tip to one target: a position (3,), m, or a pose, base frame.

    The other arguments and errors are those of `solve_many`. Raises InputError for another shape.
    """
    if isinstance(target, Frame):
        target = target.matrix()
    target = np.asarray(target, dtype=float)
    if target.shape not in ((3,), (4, 4)):
        raise InputError("ik.solve", "target", f"shape {target.shape}", "shape (3,) or (4, 4)")
    if not locked and engine is not Engine.MODEL:
        m = 3 if position_only or target.size == 3 else 6
        options = m, tol, characteristic_length(model)
        found = solve_compiled(model, target, seed, context, options, engine)
        if found is not None:
            q, (position, angle, iterations, _) = found
            reached = max(tol, REACHED)
            if position <= reached and angle <= reached:
                return Solution(q, True, Reason.CONVERGED, position, angle, int(iterations), 1)
    return solve_many(
        model,
        target[None],
        seed=seed,
        context=context,
        position_only=position_only,
        near=near,
        locked=locked,
        tol=tol,
        max_starts=max_starts,
        engine=engine,
    )[0]


def solve_many(
    model: Model,
    targets: np.ndarray,
    *,
    seed: np.ndarray | None = None,
    context: Context | None = None,
    position_only: bool = False,
    near: bool = False,
    locked: Sequence[int | str] = (),
    tol: float = TOLERANCE,
    max_starts: int = MAX_STARTS,
    engine: Engine = Engine.AUTO,
) -> Solutions:
    """Find joints that bring the tip to each of N targets.

    Args:
        model: arm and effects; measuring-side biases are not used.
        targets: positions (N, 3) in m or poses (N, 4, 4), base frame.
        seed: (n,) or (N, n) starts (rad, m), put inside the limits; default mid-range.
        context: circumstances of the targets, scalars or (N,) arrays.
        position_only: leave the orientation free (always so for (N, 3)).
        near: if a pose cannot be reached, reach its position, with an orientation as near to that
            of the pose as the joints allow.
        locked: joints that stay at their seed: 0-based numbers in q, or names.
        tol: tolerance of the search on the position (m) and on the angle (rad).
        max_starts: number of starts including the seed; 1 never leaves the seed's branch.
        engine: how to run the search; see `warm_up` for the compiled one.

    Raises:
        InputError: a shape is wrong, a number is not finite, a pose holds no rotation, or a joint
            is not known.
    """
    arm = model.arm
    wanted, m = _checked_targets(targets, position_only)
    start = checked_seed(model, seed, len(wanted))
    if not (np.isfinite(tol) and tol > 0):
        raise InputError("ik.solve_many", "tol", tol, "a number above 0")
    lower, upper = arm.box_about(start)
    for k in locked_joints(model, locked):
        lower[:, k] = upper[:, k] = start[:, k]
    context, length = context or Context(), characteristic_length(model)
    box, restarts, tol = (lower, upper), max(max_starts - 1, 0), float(tol)
    q, report = run(model, context, engine, m, wanted, start, box, restarts, tol, length)
    position, angle = report[:, 0], report[:, 1]
    iterations, starts = report[:, 2].astype(int), report[:, 3].astype(int)
    ok = np.maximum(position, angle) <= max(tol, REACHED)
    if near and m == 6 and len(off := np.flatnonzero(~ok)):
        here, box, to = context.take(off), (lower[off], upper[off]), wanted[off]
        for m_now, radian_m in ((6, _NEAR * length), (3, length)):
            q[off], found = run(model, here, engine, m_now, to, q[off], box, 0, tol, radian_m)
            iterations[off] += found[:, 2].astype(int)
        position[off] = found[:, 0]
        ok[off] = position[off] <= max(tol, REACHED)
        angle[off] = rotation_error(axes_of(tip_poses(model, q[off], here)).T, wanted[off, 3:].T)[1]
    reasons = [Reason.CONVERGED] * len(q)
    for i in np.flatnonzero(~ok):
        if iterations[i] >= starts[i] * newton.MAX_ITERATIONS:
            reasons[i] = Reason.ITERATIONS
        else:
            at_limit = (q[i] <= arm.bounds[0]) | (q[i] >= arm.bounds[1])
            reasons[i] = Reason.AT_LIMITS if at_limit.any() else Reason.OUT_OF_REACH
    return Solutions(q, ok, tuple(reasons), position, angle, iterations, starts)


def target_faults(targets: np.ndarray, position_only: bool, where: str) -> list[str]:
    """Return the fault of each of N targets; an empty string for a valid one.

    Raises InputError if their shape is not (N, 3) or (N, 4, 4).
    """
    if targets.ndim not in (2, 3) or targets.shape[1:] not in ((3,), (4, 4)):
        allowed = "shape (N, 3) or (N, 4, 4)"
        raise InputError(where, "targets", f"shape {targets.shape}", allowed)
    finite = np.isfinite(targets).all(axis=tuple(range(1, targets.ndim)))
    turned = np.ones(len(targets), bool)
    if targets.ndim == 3 and not position_only:
        T = targets if finite.all() else np.where(finite[:, None, None], targets, 0.0)
        columns = axes_of(T).T  # of one target as floats, which are quicker than arrays of one
        skew = skewness(columns[:, 0].tolist() if len(T) == 1 else columns)
        turned &= skew < REACHED**2
        turned &= (T[:, 3] == [0, 0, 0, 1]).all(axis=1)
    if finite.all() and turned.all():
        return [""] * len(targets)
    return [
        ("" if t else "its orientation is no rotation") if f else "it holds a number not finite"
        for f, t in zip(finite, turned, strict=True)
    ]


def position_of(targets: np.ndarray) -> np.ndarray:
    """Return positions (..., 3) of targets (..., 3) or (..., 4, 4), as a view."""
    return targets[..., :3, 3] if targets.shape[-2:] == (4, 4) else targets


def axes_of(T: np.ndarray) -> np.ndarray:
    """Return n, o, a one after the other, (N, 9), of poses (N, 4, 4)."""
    return T[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)


def _checked_targets(targets: np.ndarray, position_only: bool) -> tuple[np.ndarray, int]:
    """Return checked positions and axes n, o, a, (N, 12), and the equations per target, 3 or 6."""
    targets = np.asarray(targets, dtype=float)
    faults = target_faults(targets, position_only, "ik.solve_many")
    if any(faults):
        i = next(i for i, fault in enumerate(faults) if fault)
        allowed = f"finite numbers in m, a rotation and [0, 0, 0, 1]: {faults[i]}"
        raise InputError("ik.solve_many", f"target {i}", targets[i].tolist(), allowed)
    wanted = np.zeros((len(targets), 12))
    wanted[:, :3] = position_of(targets)
    if targets.ndim == 2 or position_only:
        return wanted, 3
    wanted[:, 3:] = axes_of(targets)
    return wanted, 6


def checked_seed(
    model: Model, seed: np.ndarray | None, count: int, where: str = "ik.solve_many"
) -> np.ndarray:
    """Return starts (N, n), clipped to the limits. Raises InputError for a wrong shape or value."""
    arm = model.arm
    given = np.asarray(arm.mid if seed is None else seed, dtype=float)
    if given.shape not in ((arm.n,), (count, arm.n)):
        allowed = f"shape ({arm.n},) or ({count}, {arm.n})"
        raise InputError(where, "seed", f"shape {given.shape}", allowed)
    if not np.isfinite(given).all():
        raise InputError(where, "seed", given, "finite joint values")
    made = np.empty((count, arm.n))
    made[:] = given
    low, high = arm.bounds
    return np.minimum(np.maximum(made, low, out=made), high, out=made)


def locked_joints(model: Model, locked: Sequence[int | str]) -> list[int]:
    """Return 0-based numbers in q of joints by number or name. Raises InputError if not known."""
    names = model.arm.joint_names
    indices = []
    for joint in locked:
        if isinstance(joint, str) and joint in names:
            indices.append(names.index(joint))
        elif isinstance(joint, int) and 0 <= joint < model.arm.n:
            indices.append(joint)
        else:
            allowed = f"0..{model.arm.n - 1} or one of {', '.join(names)}"
            raise InputError("ik.solve_many", "locked", joint, allowed)
    return indices
