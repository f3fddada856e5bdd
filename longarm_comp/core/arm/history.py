"""The history of the joints: how they came to where they stand.

A joint's motion is kept as *legs*: signed displacements from one reversal to the next.  Only legs
that still matter for friction or play of any size are kept: a leg at least as long as the one
before it cancels the closed loop (the wiping-out rule of the Preisach model).  So the legs
alternate in sign and grow towards the past.  A leg may span several moves; the *last way* is the
displacement since the joint last stood still or reversed (in `along`: since the previous
way-point).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.context import LEGS, PER_JOINT
from longarm_comp.core.arm.spatial import Scalar

SAME_POSE = 1e-6
"""Joint values that differ by less than this (rad, m) are the same pose."""
SLIDE = 0.1
"""Metres of a prismatic joint that count as one radian of a revolute joint."""


def add_way(legs: Sequence[float], way: float) -> list[float]:
    """Return the legs of a joint after a further signed displacement (rad, m).

    The legs are ordered latest first and contain no zeros. A leg that becomes at least as long as
    the one before it cancels that loop, as in hysteresis. Only the latest ``LEGS - 1`` are kept.
    """
    if abs(way) < SAME_POSE:
        return list(legs)
    same = legs and legs[0] * way > 0
    made = [legs[0] + way, *legs[1:]] if same else [way, *legs]
    while len(made) > 1 and abs(made[0]) >= abs(made[1]) - SAME_POSE:
        made = [sum(made[:3]), *made[3:]] if len(made) > 2 else made[:1]
    return made[: LEGS - 1]


def move_joint(side: float, legs: list[float], ways: Sequence[float]) -> tuple[float, list[float]]:
    """Return side of arrival (-1, 0: unknown, +1) and legs after displacements, the oldest first.

    `side` and `legs` are those before them; `ways` are signed (rad, m).
    """
    for way in ways:
        if abs(way) >= SAME_POSE:
            side = 1.0 if way > 0 else -1.0
            legs = add_way(legs, way)
    return side, legs


def last_way(ways: Sequence[float]) -> float:
    """Return a joint's displacement since it last reversed in a motion of `ways`, oldest first."""
    run = 0.0
    for way in reversed(ways):
        if run * way < 0.0:
            break
        run += way
    return run


def _walk(side: float, held: list[float], ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return side (k,) and legs (k, LEGS) after each of k displacements, as by `move_joint`."""
    moves = np.abs(ways) >= SAME_POSE
    done = ways[moves]
    sides = np.append(np.sign(done), side)  # the last: before the first move
    made = np.zeros((len(sides), LEGS))
    made[-1, : len(held)] = held
    cuts = np.flatnonzero(np.diff(sides[:-1])) + 1
    for begin, end in zip([0, *cuts], [*cuts, len(done)], strict=True):
        gone, at = np.cumsum(done[begin:end]), 0
        while at < len(gone):
            now = add_way(held, float(gone[at]))
            first = now[0] + gone[at:] - gone[at]
            inside = len(first)
            if len(now) > 1:  # until it cancels the leg before it
                inside = max(1, int(np.searchsorted(np.abs(first), abs(now[1]) - SAME_POSE)))
            part = made[begin + at : begin + at + inside]
            part[:, : len(now)] = now
            part[:, 0] = first[:inside]
            at += inside
        held = add_way(held, float(gone[-1])) if len(gone) else held
    row = np.cumsum(moves) - 1
    return sides[row], made[row]


def compute_play_range(legs: Sequence[Scalar], radius: Scalar) -> tuple[Scalar, Scalar]:
    """Compute the lowest and highest possible state of a play operator after some legs.

    The state follows the joint within +-radius.  Before the oldest leg it may be anything in this
    range; the two results are equal once the legs determine it.

    Args:
        legs: signed displacements between reversals, the latest first, in the unit of the
            radius; zeros have no influence.
        radius: half of the play, rad or m.
    """
    low, high = -radius, radius
    while len(legs) > 1 and isinstance(legs[-1], np.ndarray) and not np.count_nonzero(legs[-1]):
        legs = legs[:-1]  # 0 in all of the N postures
    for leg in reversed(legs):
        low = spatial.minimum(spatial.maximum(low + leg, -radius), radius)
        high = spatial.minimum(spatial.maximum(high + leg, -radius), radius)
    return low, high


@dataclass(frozen=True, eq=False)
class History:
    """The last moves of every joint: the per-joint fields of `Context` as arrays."""

    approach: np.ndarray  # (n,), or (N, n) of N postures
    legs: np.ndarray  # (n, LEGS) or (N, n, LEGS) rad, m
    last_way: np.ndarray  # (n,) or (N, n) rad, m

    @classmethod
    def unknown(cls, n: int) -> History:
        """Return the history of an arm of n joints whose earlier motion is unknown."""
        return cls(np.zeros(n), np.zeros((n, LEGS)), np.zeros(n))

    def after(self, points: np.ndarray, start: np.ndarray | None) -> History:
        """Return the history after a move from rest to rest.

        Args:
            points: (k, n) way-points, rad and m; the joints come to rest at the last.
            start: (n,) where the joints stood; None if neither this nor their history is known.
        """
        path = points if start is None else np.concatenate([start[None], points])
        ways = np.diff(path, axis=0).T.tolist()
        sides, made = self.approach.astype(float), np.zeros_like(self.legs)
        for joint, held in enumerate(self.legs.tolist()):
            before = [] if start is None else [leg for leg in held if leg]
            side, after = move_joint(float(sides[joint]), before, ways[joint])
            sides[joint], made[joint, : len(after)] = side, after
        return History(sides, made, np.array([last_way(each) for each in ways]))

    def along(self, points: np.ndarray, start: np.ndarray | None) -> History:
        """Return the history at each of k way-points of one motion without a stop.

        Every field has one more axis, of length k, in front. Sides and legs are those of `after`;
        `last_way` is the displacement since the previous way-point.  The arguments are those of
        `after`; with an unknown start the motion begins at the first way-point.
        """
        first = points[0] if start is None else start
        ways = np.diff(points, axis=0, prepend=first[None])
        sides, made = np.zeros(ways.shape), np.zeros((*ways.shape, LEGS))
        for joint, (side, legs) in enumerate(zip(self.approach, self.legs.tolist(), strict=True)):
            held = [] if start is None else [leg for leg in legs if leg]
            sides[:, joint], made[:, joint] = _walk(float(side), held, ways[:, joint])
        return History(sides, made, ways)

    def with_sides(self, sides: np.ndarray) -> History:
        """Return the history with some sides of arrival replaced.

        Args:
            sides: (n,) of +-1; 0 leaves a joint as it is. The displacements of joints whose side
                is replaced become unknown.
        """
        return self._of_joints(sides == 0, sides)

    def agrees(self, other: History) -> bool:
        """Tell whether two histories are equal to within 10 microradians or micrometres."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in PER_JOINT)
        return all(np.allclose(*pair, rtol=0.0, atol=1e-5) for pair in pairs)  # rad, m

    def common_with(self, other: History) -> History:
        """Return this history, set to 0 (unknown) for joints whose sides of arrival differ."""
        return self._of_joints(np.sign(self.approach) == np.sign(other.approach), 0)

    def _of_joints(self, known: np.ndarray, sides: np.ndarray | int) -> History:
        """Return the history, of which joints not `known` (n,) keep nothing but the given sides."""
        legs = np.where(known[:, None], self.legs, 0.0)
        approach = np.where(known, self.approach, sides)
        return History(approach, legs, np.where(known, self.last_way, 0.0))

    def fields(self) -> dict[str, Any]:
        """Return the per-joint fields of a `Context` of one posture or N; 0 where unknown."""
        held = {name: getattr(self, name) for name in PER_JOINT}
        if self.approach.ndim == 1:
            return {name: tuple(values.ravel().tolist()) for name, values in held.items()}
        return {name: tuple(values.reshape(len(values), -1).T) for name, values in held.items()}


def recorded_history(
    q: np.ndarray,
    index: np.ndarray,
    approach: np.ndarray | None = None,
    run_up: np.ndarray | None = None,
    length: np.ndarray | None = None,
) -> History:
    """Return the history of every row of a recording, (N, n).

    A joint arrived by its recorded run-up, else from the recorded side, else straight from the row
    before.  In the first row and after a gap of the index, the earlier motion is unknown.  A joint
    that did not move keeps its side.  Rows of one stop (`first_of_stand`) share their last way.

    Args:
        q: (N, n) commanded joints in the order of recording, rad and m.
        index: (N,) counter of the recording; a step other than 0 or 1 is a gap.
        approach: (N,) or (N, n) sides of arrival, with 0 or NaN where none was recorded.
        run_up: (N, n) where the run-up began; NaN where there was none or this is not known.
        length: (n,) length (rad, m) of run-ups of which only the side was recorded; by default it
            is unknown.
    """
    begun = np.full(q.shape, np.nan) if run_up is None else run_up
    told = read_sides(q, approach, begun)
    if length is not None:
        begun = np.where(told != 0, q - told * length, begun)
        told = np.zeros_like(told)
    via = np.where(np.isnan(begun), q, begun)
    sides, legs = np.zeros(q.shape), np.zeros((*q.shape, LEGS))
    last, gap = np.zeros(q.shape), np.isnan(straight_ways(q, index)[:, 0])
    for joint in range(q.shape[1]):
        before, side, now = 0.0, 0.0, list[float]()
        rows = zip(*(a[:, joint].tolist() for a in (q, via, told)), gap.tolist(), strict=True)
        for i, (here, turn, mark, unknown) in enumerate(rows):
            ways = [here - turn] if unknown else [turn - before, here - turn]
            side, now = move_joint(*((0.0, []) if unknown else (side, now)), ways)
            if mark:
                side, now, ways = mark, [], []
            before = here
            sides[i, joint], legs[i, joint, : len(now)] = side, now
            last[i, joint] = last_way(ways)
    return History(sides, legs, last[first_of_stand(q, index)])


def straight_ways(q: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return (N, n) displacements (rad, m) from the row before; NaN after a gap of the index."""
    ways = np.full(q.shape, np.nan)
    known = np.isin(np.diff(index), (0, 1))
    ways[1:][known] = np.diff(q, axis=0)[known]
    return ways


def first_of_stand(q: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return for each row (N,) the first row of its stop: successive ones of equal index and q."""
    moved = np.ones(len(q), dtype=bool)
    moved[1:] = (np.diff(index) != 0) | (np.abs(np.diff(q, axis=0)) >= SAME_POSE).any(axis=1)
    return np.maximum.accumulate(np.where(moved, np.arange(len(q)), 0))


def read_sides(q: np.ndarray, approach: np.ndarray | None, run_up: np.ndarray) -> np.ndarray:
    """Return the recorded side of arrival, (N, n) of -1, 0, +1; 0 if the run-up is recorded.

    The arguments are those of `recorded_history`.
    """
    return np.where(np.isnan(run_up), _each_side(q, approach), 0.0)


def list_wrong_run_ups(
    q: np.ndarray, approach: np.ndarray | None, run_up: np.ndarray
) -> Iterator[tuple[int, int, str]]:
    """Yield row, joint and what is allowed for each run-up that denies the recorded side.

    The arguments are those of `recorded_history`.
    """
    sides = _each_side(q, approach)
    for row, joint in np.argwhere((sides != 0) & ((q - run_up) * sides < SAME_POSE)).tolist():
        side = "below" if sides[row, joint] > 0 else "above"
        yield row, joint, f"a place {side} q{joint + 1}, as approach says"


def _each_side(q: np.ndarray, approach: np.ndarray | None) -> np.ndarray:
    marks = np.sign(np.nan_to_num(np.asarray(0.0 if approach is None else approach, dtype=float)))
    return np.broadcast_to(marks[:, None] if marks.ndim == 1 else marks, q.shape)
