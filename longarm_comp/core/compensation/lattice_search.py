"""The search behind `realisable`: linearise, find the nearest points of the lattice, judge them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.box_step import rotation_error
from longarm_comp.core.ik.lattice import NOTHING, nearest

_DIFFERENCE = 1e-4
"""Half the difference (rad, m) from which the tip's derivative is taken."""
EDGE = 1e-9
"""Share of a step, or rad or m, by which rounding may put a joint beyond a limit."""

Predict = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""The tip at joints (M, n) of targets number (M,): positions (M, 3) in m or poses (M, 4, 4)."""


@dataclass(frozen=True)
class Search:
    """How realisable joints are looked for.

    Attributes:
        price_m: tip error (m) that a revolute joint may cost by moving 1 rad off the ideal; a slide
            pays as much for as many metres as a radian is at ``length_m``.
        length_m: metres that a radian of tool angle counts for; best the arm's own
            (`ik.kernel.characteristic_length`).
        kept: points of the lattice that the model judges in each round.
        rounds: linearisations, the first at the rounded joints, the others at the best so far.
        max_nodes: of the search tree of one target and round.
    """

    length_m: float
    price_m: float = math.degrees(1e-4)
    kept: int = 16
    rounds: int = 2
    max_nodes: int = 5000

    def __post_init__(self) -> None:
        for name in ("length_m", "price_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError("realisable", name, value, "a finite number above 0")
        for name in ("kept", "rounds", "max_nodes"):
            if getattr(self, name) < 1:
                raise InputError("realisable", name, getattr(self, name), "1 or more")


class Found(NamedTuple):
    """Joints (N, n), rounded joints (N, n), errors (N, 3, 2) and nodes (N,).

    The errors are those at the ideal joints, at the rounded ones and at the joints: m and rad.
    """

    joints: np.ndarray
    rounded: np.ndarray
    errors: np.ndarray
    nodes: np.ndarray


@dataclass(frozen=True)
class LatticeProblem:
    """What N targets share: where the joints may stand, and what it costs.

    Attributes:
        lower, upper: (n,) limits.
        stepped: numbers of the joints with steps: ``offset + step k``, k from low to high, each
            of these of length s.
        free: numbers of the joints that are solved for beside them; the others stay.
        price: (n,) m per rad or m off the ideal joints.
    """

    lower: np.ndarray
    upper: np.ndarray
    stepped: np.ndarray
    free: np.ndarray
    offset: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray
    price: np.ndarray

    def solve(
        self, predict: Predict, targets: np.ndarray, ideal: np.ndarray, search: Search
    ) -> Found:
        """Joints for N targets; the arguments are those of `realisable.choose`."""
        ideal = np.clip(ideal, self.lower, self.upper)
        # targets at a time
        parts = [
            _Search(self, search, predict, targets[ids], ideal[ids], ids).found()
            for ids in np.array_split(np.arange(len(ideal)), -(-len(ideal) // 2048) or 1)
        ]
        return Found(*map(np.concatenate, zip(*parts, strict=True)))

    @cached_property
    def moving(self) -> np.ndarray:
        """Numbers of the joints that are not held: the free ones, then the stepped ones."""
        return np.concatenate([self.free, self.stepped])

    def whole(self, q: np.ndarray) -> np.ndarray:
        """The k inside the limits that are nearest to joints (N, n): (N, s)."""
        return np.clip(np.rint((q[:, self.stepped] - self.offset) / self.step), self.low, self.high)

    def at(self, q: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Joints (..., n) with the stepped ones at k (..., s)."""
        q = q.copy()
        q[..., self.stepped] = self.offset + self.step * k
        return np.clip(q, self.lower, self.upper)


class _Search:
    """Some targets at a time.  Shapes: N targets, M candidates of each, m equations."""

    def __init__(
        self,
        problem: LatticeProblem,
        search: Search,
        predict: Predict,
        targets: np.ndarray,
        ideal: np.ndarray,
        ids: np.ndarray,
    ) -> None:
        self.problem, self.search, self.predict, self.ids = problem, search, predict, ids
        self.position = targets if targets.ndim == 2 else targets[:, :3, 3]
        self.axes = None if targets.ndim == 2 else _axes(targets)
        self.ideal, self.whole = ideal, problem.whole(ideal)
        self.rounded = problem.at(ideal, self.whole)
        self.nodes = np.zeros(len(ideal))

    def found(self) -> Found:
        """Round after round the best of rounding, of what was the best, and of what is near."""
        first = np.concatenate([self.ideal[:, None], self.around(self.rounded)], axis=1)
        errors = self.errors(first)
        bad = np.flatnonzero(~np.isfinite(errors[:, :2]).all(axis=(1, 2)))
        if bad.size:
            allowed = (
                f"a finite tip at the ideal and the rounded joints of target {self.ids[bad[0]]}"
            )
            raise InputError("realisable", "predict", "not finite", allowed)
        best, error, local = self.rounded, errors[:, 1], errors[:, 1:]
        for turn in range(self.search.rounds if self.problem.stepped.size else 0):
            if turn:
                local = self.errors(self.around(best))
            tried = np.concatenate([best[:, None], self.near(best, local)], axis=1)
            left = self.errors(tried)
            moved = self.problem.price * (tried - self.ideal[:, None])
            cost = (left**2).sum(axis=2) + (moved**2).sum(axis=2)
            cost[np.isnan(cost)] = np.inf
            place = np.argmin(cost, axis=1)[:, None, None]
            best = np.take_along_axis(tried, place, axis=1)[:, 0]
            error = np.take_along_axis(left, place, axis=1)[:, 0]
        rows = np.concatenate([errors[:, :2], error[:, None]], axis=1)
        length = np.linalg.norm(rows[..., :3], axis=2)
        angle = np.linalg.norm(rows[..., 3:], axis=2) / self.search.length_m
        return Found(best, self.rounded, np.stack([length, angle], axis=2), self.nodes)

    def errors(self, q: np.ndarray) -> np.ndarray:
        """Tip less target at joints (N, M, n): m, and rad times a length, (N, M, m)."""
        rows = np.repeat(np.arange(len(q)), q.shape[1])
        tip = np.asarray(self.predict(q.reshape(-1, q.shape[2]), self.ids[rows]), float)
        posed = tip.shape == (len(rows), 4, 4)
        if not posed and (self.axes is not None or tip.shape != (len(rows), 3)):
            allowed = f"shape ({len(rows)}, {'3' if self.axes is None else '4, 4'})"
            raise InputError("realisable", "predict", f"shape {tip.shape}", allowed)
        made = (tip[:, :3, 3] if posed else tip) - self.position[rows]
        if self.axes is not None:
            turn = np.zeros((3, len(rows)))
            rotation_error(self.axes[rows].T, 0, _axes(tip).T, 0, turn, 0)
            made = np.concatenate([made, self.search.length_m * turn.T], axis=1)
        shaped: np.ndarray = made.reshape(*q.shape[:2], made.shape[1])
        return shaped

    def near(self, at: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Candidates (N, kept, n) by the model linearised at joints (N, n).

        Of joints ``rounded + size x`` the tip's error and the price are ``A x + b``; with the free
        joints before the stepped ones the triangular factor of (A b) parts them.

        Args:
            local: errors at the joints that `around` gives.
        """
        problem, count = self.problem, len(at)
        moving = problem.moving
        size = np.concatenate([np.ones(problem.free.size), problem.step])
        price = problem.price[moving]
        error, slope = local[:, 0], self.slope(at, local)
        off = (self.rounded - at)[:, moving]
        A = np.empty((count, error.shape[1] + moving.size, moving.size + 1))
        m = error.shape[1]
        A[:, :m, :-1] = slope * size
        A[:, :m, -1] = error + (slope @ off[..., None])[..., 0]
        A[:, m:, :-1] = np.diag(price * size)
        A[:, m:, -1] = price * (self.rounded - self.ideal)[:, moving]
        factor: np.ndarray = np.linalg.qr(A, mode="r")  # type: ignore[assignment]
        R, f = factor[:, : moving.size], problem.free.size
        points = nearest(
            R[:, f:, f:],
            problem.low - self.whole,
            problem.high - self.whole,
            kept=self.search.kept,
            max_nodes=self.search.max_nodes,
        )
        self.nodes += points.nodes
        q = np.repeat(self.rounded[:, None], self.search.kept, axis=1)
        if f:
            b = np.einsum("nfs,nks->nkf", R[:, :f, f:-1], points.k) + R[:, None, :f, -1]
            low, high = (
                v[problem.free] - self.ideal[:, problem.free]
                for v in (problem.lower, problem.upper)
            )
            q[..., problem.free] += _in_box(R[:, :f, :f], b, low, high)
        q = problem.at(q, self.whole[:, None] + points.k)
        nothing = (points.distance2 >= NOTHING)[..., None]
        return np.where(nothing, self.rounded[:, None], q)

    def around(self, at: np.ndarray) -> np.ndarray:
        """Joints (N, n), then with each moving one a little up, then a little down, in limits."""
        moving = self.problem.moving
        number = 1 + np.arange(moving.size)
        q = np.repeat(at[:, None], 1 + 2 * moving.size, axis=1)
        up = np.minimum(at + _DIFFERENCE, self.problem.upper)
        down = np.maximum(at - _DIFFERENCE, self.problem.lower)
        q[:, number, moving] = up[:, moving]
        q[:, moving.size + number, moving] = down[:, moving]
        return q

    def slope(self, at: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Derivative (N, m, moving) from the errors at the joints that `around` gives."""
        moving = self.problem.moving
        up = np.minimum(at + _DIFFERENCE, self.problem.upper)
        down = np.maximum(at - _DIFFERENCE, self.problem.lower)
        rise = local[:, 1 : 1 + moving.size] - local[:, 1 + moving.size :]
        slope = (rise / (up - down)[:, moving, None]).swapaxes(1, 2)
        return np.where(np.isfinite(slope), slope, 0.0)


def _axes(T: np.ndarray) -> np.ndarray:
    """n, o, a one after the other, (N, 9), of poses (N, 4, 4)."""
    return T[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)


def _in_box(R: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """x (N, M, f) between low and high (N, f) with ``|R x + b|`` small; R (N, f, f), b (N, M, f).

    What leaves the box is put on its edge, the furthest out first, and the rest solved again.
    """
    G = np.einsum("nkf,nkg->nfg", R, R)[:, None]
    g = np.einsum("nkf,nmk->nmf", R, b)
    x = np.zeros_like(g)
    held = np.zeros(g.shape, bool)
    eye = np.eye(g.shape[2])
    for _ in range(g.shape[2] + 1):
        open_ = ~held
        matrix = np.where(open_[..., :, None] & open_[..., None, :], G, eye)
        rest = -(g + (G @ (held * x)[..., None])[..., 0])
        x = np.linalg.solve(matrix, np.where(held, x, rest)[..., None])[..., 0]
        inside = np.clip(x, low[:, None], high[:, None])
        out = np.abs(x - inside)
        if not out.any():
            break
        worst = (out > 0) & (out == out.max(axis=2, keepdims=True))
        x, held = np.where(worst, inside, x), held | worst
    return np.clip(x, low[:, None], high[:, None])
