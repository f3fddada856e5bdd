"""How the joints came to where they stand: the per-joint fields of the record of circumstances.

One step, from rest to rest, serves recorded sessions and the running arm alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import PER_JOINT

SAME_POSE = 1e-6
"""Commanded joints that differ by less are the same pose (rad, m)."""

_AGREED = 1e-5


@dataclass(frozen=True, eq=False)
class History:
    """What every joint did last. Its fields are the per-joint fields of `Context`.

    Attributes:
        approach: (n,) or (N, n) of -1, 0 (unknown), +1: the side each joint arrived from.
        travel: (n,) or (N, n) signed way since it last turned round, from rest to rest (rad, m);
            a run-up before the arrival is not counted; 0 unknown.
    """

    approach: np.ndarray
    travel: np.ndarray

    @classmethod
    def unknown(cls, n: int) -> History:
        """Of an arm of n joints that nobody has watched."""
        return cls(np.zeros(n), np.zeros(n))

    def after(self, points: np.ndarray, start: np.ndarray | None) -> History:
        """After a move from rest to rest.

        Args:
            points: (k, n) way-points; the joints come to rest at the last.
            start: (n,) where the joints stood; None: nobody knows.
        """
        path = points if start is None else np.vstack([start, points])
        side = self.approach
        for step in np.diff(path, axis=0):
            side = np.where(np.abs(step) < SAME_POSE, side, np.sign(step))
        return History(side, self.travel if start is None else self._onward(path[-1] - path[0]))

    def _onward(self, step: np.ndarray) -> np.ndarray:
        """Way after a further step: a joint that goes on adds up, one that turns begins anew."""
        step = np.where(np.abs(step) < SAME_POSE, 0.0, step)
        return np.where(self.travel * step >= 0, self.travel + step, step)

    def agrees(self, other: History) -> bool:
        """Whether every joint came the same way, to 10 microradians or micrometres."""
        return all(
            np.allclose(getattr(self, name), getattr(other, name), rtol=0.0, atol=_AGREED)
            for name in PER_JOINT
        )

    def agreed(self, other: History) -> History:
        """What both say; 0, unknown, where they point to opposite sides."""
        return History(
            **{
                name: np.where(
                    np.sign(getattr(self, name)) == np.sign(getattr(other, name)),
                    getattr(self, name),
                    0.0,
                )
                for name in PER_JOINT
            }
        )

    def fields(self) -> dict[str, Any]:
        """The per-joint fields of a `Context` at one posture, 0 where they are unknown."""
        return {name: tuple(getattr(self, name).tolist()) for name in PER_JOINT}


def recorded(q: np.ndarray, index: np.ndarray, approach: np.ndarray | None = None) -> History:
    """History of every row of a recording, (N, n).

    A recorded side of +1 or -1 stands. Else it is the direction of motion from the row before; a
    joint that did not move keeps its side. After a gap of the index, and in the first row,
    nothing is known.

    Args:
        q: (N, n) commanded joints in the order of recording.
        index: (N,) counter of the recording.
        approach: (N,) or (N, n) with 0 or NaN where no side was recorded.
    """
    given = np.zeros(q.shape)
    if approach is not None:
        marks = np.nan_to_num(np.asarray(approach, dtype=float))
        given[:] = np.sign(marks if marks.ndim == 2 else marks[:, None])
    sides, ways = np.zeros(q.shape), np.zeros(q.shape)
    now = nothing = History.unknown(q.shape[1])
    for i in range(len(q)):
        gap = i == 0 or not 0 <= index[i] - index[i - 1] <= 1
        now = nothing if gap else now.after(q[i : i + 1], q[i - 1])
        now = History(np.where(given[i] != 0, given[i], now.approach), now.travel)
        sides[i], ways[i] = now.approach, now.travel
    return History(sides, ways)
