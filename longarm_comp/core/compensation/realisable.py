"""Chooses joint values at which the servos can stand, all together, so that the tip is nearest to
its target.

A servo stands at ``offset + step k`` for whole k.  With q* the ideal joints, e0 the tip's error
there and J its derivative, the search (`lattice`) finds the k that minimise::

    |J (offset + step k - q*) + e0|^2 + |price (offset + step k - q*)|^2,   inside the limits;

The model itself judges the best of them and plain rounding, and is linearised again at the best.
Joints without a step are solved for at the same time.  Neighbouring targets get joints up to a
degree apart, so a path of close targets is smoother with rounding (docs/realisable.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.lattice import EDGE, nearest
from longarm_comp.core.ik.newton import rotation_error
from longarm_comp.core.ik.solver import axes_of, position_of

Predict = Callable[[np.ndarray], np.ndarray]
"""Function that returns the tip at joints (M, n): positions (M, 3) in m, or poses (M, 4, 4)."""

_DIFFERENCE = 1e-4
"""Half the difference (rad, m) by which the tip's derivative is computed."""
KNOWN_TO = 0.15
"""Largest standard deviation of a lattice's offset, as a share of the step, that can be used."""


@dataclass(frozen=True)
class Lattice:
    """The values at which servos can stand: joint j at ``offset[j] + step[j] k`` for whole k."""

    step: np.ndarray  # (n,) rad or m; 0: the joint is continuous
    offset: np.ndarray  # (n,) rad or m
    offset_sd: np.ndarray  # (n,) rad or m, standard deviation of the offset

    @classmethod
    def of(cls, arm: Arm, offset: Any = 0.0, offset_sd: Any = 0.0) -> Lattice:
        """Make the lattice of the steps that an arm declares.

        Args:
            offset, offset_sd: rad or m, one number for all joints or (n,).

        Raises:
            InputError: a wrong shape or value.
        """
        made = [arm.steps]
        for name, value in (("offset", offset), ("offset_sd", offset_sd)):
            given = np.asarray(value, float)
            if given.shape not in ((), (arm.n,)):
                allowed = f"one number or ({arm.n},)"
                raise InputError("realisable", name, f"shape {given.shape}", allowed)
            if not np.isfinite(given).all() or (name == "offset_sd" and (given < 0).any()):
                allowed = "finite numbers" + (" of 0 or more" if name == "offset_sd" else "")
                raise InputError("realisable", name, given.tolist(), allowed)
            made.append(np.broadcast_to(given, (arm.n,)))
        return cls(*made)

    @property
    def is_known(self) -> np.ndarray:
        """(n,) bool: whether the joint has steps whose offset is known well enough."""
        return np.asarray((self.step > 0) & (self.offset_sd <= KNOWN_TO * self.step))


@dataclass(frozen=True)
class Search:
    """The settings of a search for realisable joints.

    Attributes:
        length_m: length by which orientation errors (rad) are multiplied to compare them with tip
            errors (m); best `ik.kernel.characteristic_length`.
        price_m: tip error (m) that counts as much as a deviation of 1 rad of a revolute joint, or
            of `length_m` metres of a prismatic one, from its ideal value.
        kept: number of lattice points that the model judges in each round.
        rounds: number of linearisations: first at the rounded joints, then at the best so far.
        max_nodes: largest number of nodes in the search of one target and round.
    """

    length_m: float
    price_m: float = math.degrees(1e-4)
    kept: int = 16
    rounds: int = 2
    max_nodes: int = 5000


@dataclass(frozen=True)
class Realisable:
    """The chosen joints for one target.

    Each error is the predicted tip error (2,): m, and rad (0 for positions).
    """

    joints: np.ndarray  # (n,) joints to command, inside the limits
    ideal: np.ndarray  # (n,) joints that were given, clipped to the limits
    rounded: np.ndarray  # (n,) the ideal joints, each rounded to its nearest step
    ideal_error: np.ndarray  # at `ideal`
    rounded_error: np.ndarray  # at `rounded`
    error: np.ndarray  # at `joints`
    nodes: int  # number of nodes that the searches visited
    reason: str  # why the choice is plain rounding; empty if it is not
    note: str  # which joints with steps stay at their ideal value, and why


def choose(
    arm: Arm,
    lattice: Lattice,
    predict: Predict,
    target: np.ndarray,
    ideal: np.ndarray,
    search: Search,
    *,
    locked: Sequence[int] = (),
) -> Realisable:
    """Choose joints at which the servos can stand and the tip is nearest to its target.

    Args:
        lattice: the values at which the servos can stand; a joint whose offset is not known to
            `KNOWN_TO` of its step stays at its ideal value.
        predict: predicts the tip, with learned error and circumstances.
        target: position (3,) in m or pose (4, 4), base frame.
        ideal: (n,) joints that bring the tip to the target, inside the limits.
        locked: 0-based numbers of joints that stay at their ideal value.

    Raises:
        InputError: the predicted tip at the ideal or the rounded joints is not finite.
    """
    problem = _Problem(arm, lattice, predict, target, ideal, search, locked)
    errors = problem.errors(np.vstack([problem.ideal, problem.step_aside(problem.rounded)]))
    if not np.isfinite(errors[:2]).all():
        allowed = "a finite tip at the ideal and the rounded joints"
        raise InputError("realisable", "predict", "not finite", allowed)
    best, error, local, nodes = problem.rounded, errors[1], errors[1:], 0
    for turn in range(search.rounds if len(problem.stepped) else 0):
        if turn:
            local = problem.errors(problem.step_aside(best))
        near, visited = problem.find_near(best, local)
        tried = np.vstack([best, near])  # the present choice and its neighbours
        left = problem.errors(tried)
        moved = problem.price * (tried - problem.ideal)
        cost = (left**2).sum(axis=1) + (moved**2).sum(axis=1)
        place = int(np.argmin(np.where(np.isnan(cost), np.inf, cost)))
        best, error, nodes = tried[place], left[place], nodes + visited
    rows = np.vstack([errors[:2], error])
    angle = np.linalg.norm(rows[:, 3:], axis=1) / search.length_m
    sizes = np.stack([np.linalg.norm(rows[:, :3], axis=1), angle], axis=1)
    why = "" if len(problem.stepped) else "no joint's steps are known"
    if not why and (best == problem.rounded).all():
        why = "no choice was better than rounding"
    return Realisable(
        joints=best,
        ideal=problem.ideal,
        rounded=problem.rounded,
        ideal_error=sizes[0],
        rounded_error=sizes[1],
        error=sizes[2],
        nodes=nodes,
        reason=why,
        note=problem.note,
    )


class _Problem:
    """One target, and the values that the joints may take.  Shapes: M candidates, m equations."""

    def __init__(
        self,
        arm: Arm,
        lattice: Lattice,
        predict: Predict,
        target: np.ndarray,
        ideal: np.ndarray,
        search: Search,
        locked: Sequence[int],
    ) -> None:
        self.predict, self.target, self.search = predict, target, search
        self.lower, self.upper = arm.box_about(ideal)
        self.ideal = np.clip(ideal, self.lower, self.upper)
        # (n,) tip error (m) that counts as much as a deviation of 1 rad or 1 m from the ideal value
        self.price = search.price_m / np.where(arm.slides, search.length_m, 1.0)
        is_locked = np.isin(np.arange(arm.n), locked)
        # Lowest and highest k inside the limits; not used for continuous joints
        step = np.where(lattice.step > 0, lattice.step, 1.0)
        low = np.ceil((self.lower - lattice.offset) / step - EDGE)
        high = np.floor((self.upper - lattice.offset) / step + EDGE)
        declared = (lattice.step > 0) & ~is_locked
        # Numbers of the s joints with steps, which stand at ``offset + step k``, and of the
        # continuous joints that may move. Joints in neither list keep their value.
        on = self.stepped = np.flatnonzero(declared & lattice.is_known & (low <= high))
        self.free = np.flatnonzero((lattice.step == 0) & ~is_locked)
        self.moving = np.concatenate([self.free, on])
        self.offset, self.step = lattice.offset[on], lattice.step[on]
        self.low, self.high = low[on], high[on]
        # (s,) the k inside the limits that are nearest to the ideal joints
        whole = np.rint((self.ideal[on] - self.offset) / self.step)
        self.whole = np.clip(whole, self.low, self.high)
        self.rounded = self.at_steps(self.ideal, self.whole)
        causes = {
            f"the offset of its steps is not known to {KNOWN_TO} of a step": ~lattice.is_known,
            "none of its steps lies inside its limits": lattice.is_known & (low > high),
        }
        self.note = "; ".join(
            f"{arm.joint_names[j]} stays at its ideal value: {why}"
            for why, mask in causes.items()
            for j in np.flatnonzero(declared & mask)
        )

    def at_steps(self, q: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return joints q (..., n) with the stepped ones at steps k (..., s), inside the limits."""
        q = q.copy()
        q[..., self.stepped] = self.offset + self.step * k
        return np.clip(q, self.lower, self.upper)

    def errors(self, q: np.ndarray) -> np.ndarray:
        """Compute tip - target at joints (M, n): (M, m) in m, angles in rad times `length_m`."""
        tip = self.predict(q)
        made = position_of(tip) - position_of(self.target)
        if self.target.ndim == 1:
            return np.asarray(made)
        axes = axes_of(self.target[None]).repeat(len(q), axis=0)
        turn, _ = rotation_error(axes.T, axes_of(tip).T)
        return np.column_stack([made, *(self.search.length_m * v for v in turn)])

    def find_near(self, at: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, int]:
        """Find the best candidates (M, n) of the linearised model, and count the nodes visited.

        For joints ``rounded + size x`` the tip's error and the price are ``A x + b``. The free
        joints come before the stepped ones, so the triangular factor of (A b) separates the two.

        Args:
            at: (n,) joints at which the model is linearised.
            local: (1 + 2 k, m) errors at the joints of `step_aside`.
        """
        moving, m, f = self.moving, local.shape[1], len(self.free)
        size = np.concatenate([np.ones(f), self.step])
        price, (up, down) = self.price[moving], self._aside(at)
        slope = ((local[1 : 1 + len(moving)] - local[1 + len(moving) :]) / (up - down)[:, None]).T
        slope = np.where(np.isfinite(slope), slope, 0.0)
        A = np.empty((m + len(moving), len(moving) + 1))
        A[:m, :-1] = slope * size
        A[:m, -1] = local[0] + slope @ (self.rounded - at)[moving]
        A[m:, :-1] = np.diag(price * size)
        A[m:, -1] = price * (self.rounded - self.ideal)[moving]
        factor: np.ndarray = np.linalg.qr(A, mode="r")  # type: ignore[assignment]
        R = factor[: len(moving)]
        k, nodes = nearest(
            R[f:, f:],
            self.low - self.whole,
            self.high - self.whole,
            kept=self.search.kept,
            max_nodes=self.search.max_nodes,
        )
        q = np.repeat(self.rounded[None], len(k), axis=0)
        if f:
            b = k @ R[:f, f:-1].T + R[:f, -1]
            low, high = ((v - self.ideal)[self.free] for v in (self.lower, self.upper))
            q[:, self.free] += _solve_in_box(R[:f, :f], b, low, high)
        return self.at_steps(q, self.whole + k), nodes

    def step_aside(self, at: np.ndarray) -> np.ndarray:
        """Return joints (1 + 2 k, n) for differences of the k moving joints, inside the limits.

        First ``at`` (n,), then each moving joint a little higher, then each a little lower.
        """
        count = len(self.moving)
        q = np.repeat(at[None], 1 + 2 * count, axis=0)
        up, down = self._aside(at)
        q[np.arange(1, 1 + 2 * count), np.tile(self.moving, 2)] = np.append(up, down)
        return q

    def _aside(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the moving joints a little higher and a little lower, (k,) each, within limits."""
        up = np.minimum(at + _DIFFERENCE, self.upper)
        return up[self.moving], np.maximum(at - _DIFFERENCE, self.lower)[self.moving]


def _solve_in_box(R: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return x (M, f) between low and high (f,) with ``|R x + b|`` small; R (f, f), b (M, f).

    Again and again, the unknown that is farthest outside the box is fixed at its edge, and the
    others are solved again.
    """
    G, g = R.T @ R, b @ R
    x, on_edge = np.zeros_like(g), np.zeros(g.shape, bool)
    for _ in range(g.shape[1] + 1):
        open_ = ~on_edge
        matrix = np.where(open_[:, :, None] & open_[:, None, :], G, np.eye(len(G)))
        rest = -(g + (on_edge * x) @ G)
        x = np.linalg.solve(matrix, np.where(on_edge, x, rest)[..., None])[..., 0]
        inside = np.clip(x, low, high)
        out = np.abs(x - inside)
        if not out.any():
            break
        worst = (out > 0) & (out == out.max(axis=1, keepdims=True))
        x, on_edge = np.where(worst, inside, x), on_edge | worst
    return np.clip(x, low, high)
