"""Commands are moves: from which side every joint arrives, and the run-up that makes it so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE


@dataclass(frozen=True, eq=False)
class Move:
    """The way in which the joints come to rest at a command.

    Attributes:
        q: (n,) where they rest (rad, m).
        run_up: (n,) where the last approach begins, or None where the direct move will do.
        side: (n,) of -1, 0, +1: the side that each joint arrives from; 0: it does not move.
        doubtful: (n,) joints whose side was wanted but whose way is shorter than a run-up, and
            that have no room for one.
    """

    q: np.ndarray
    run_up: np.ndarray | None
    side: np.ndarray
    doubtful: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """The (k, n) way-points to send, rad and m: one, or two with a run-up."""
        return self.q[None] if self.run_up is None else np.stack([self.run_up, self.q])


def run_up_lengths(arm: Arm) -> np.ndarray:
    """Return (n,) shortest length of a run-up of every joint (rad, m)."""
    # Way of a run-up, as a share of each joint's range: longer than the play of most joints
    return 0.06 * (arm.upper - arm.lower)


def plan_move(
    arm: Arm,
    start: np.ndarray | None,
    q: np.ndarray,
    wanted: np.ndarray,
    *,
    length: np.ndarray | None = None,
    leg: np.ndarray | None = None,
) -> Move:
    """Return the shortest move that arrives at q from the wanted sides, inside the limits.

    A joint needs no run-up whose direct way comes from its side and is as long as the shortest one,
    if with the way before it is as long as a run-up.  One that has no room for the shortest goes
    directly and is marked.  Joints that need no run-up are put on their own way to q while the
    others run up, so that they too arrive from their side.

    Args:
        start, q: (n,) where the joints stand (None: nobody knows), and where they shall rest.
        wanted: (n,) of -1, 0, +1; 0: any side.
        length: (n,) of a run-up that has room for it (rad, m); by default the shortest.
        leg: (n,) signed way (rad, m) of every joint at ``start`` since it turned; 0: not known.
    """
    least = run_up_lengths(arm)
    step = np.zeros_like(q) if start is None else q - start
    natural = np.where(np.abs(step) < SAME_POSE, 0.0, np.sign(step))
    room = _room(arm, q, wanted)
    length = np.minimum(least if length is None else np.maximum(least, length), room)
    before = np.zeros_like(q) if leg is None else np.maximum(natural * leg, 0.0)
    way = np.abs(step) + before
    arrives = (natural == wanted) & (np.abs(step) >= least) & (way >= length)
    direct = (wanted == 0) | arrives
    runs_up = ~direct & (room >= least)
    doubtful = ~direct & ~runs_up
    if not runs_up.any():
        return Move(q, None, natural, doubtful)
    via = np.clip(q - wanted * length, *arm.bounds)
    on_the_way = q - natural * np.minimum(least, np.abs(step))
    run_up = np.where(runs_up, via, on_the_way)
    return Move(q, run_up, np.where(runs_up, wanted, natural), doubtful)


def _room(arm: Arm, q: np.ndarray, sides: np.ndarray | float) -> np.ndarray:
    """Return the (n,) longest run-up (rad, m) to q from each joint's side, -1 or +1."""
    lower, upper = arm.bounds
    return np.where(np.greater(sides, 0.0), q - lower, upper - q)


def wanted_sides(
    arm: Arm,
    start: np.ndarray | None,
    q: np.ndarray,
    known: np.ndarray,
    sure: np.ndarray | float = 0.0,
    length: np.ndarray | None = None,
) -> np.ndarray:
    """Choose the (n,) side, -1 or +1, from which each joint shall arrive.

    It is the side at which the effects are surest, else that of the direct way. The other side is
    taken where this one has no room, or where the other one is three times better: by what the data
    know of it, and by the share of a run-up that it has room for.

    Args:
        start, q: as in `plan_move`.
        sure: (n,) sides at which the effects are surest; 0: either.
        known: (n, 2) weight of what the data know of arrivals from above (-1) and from below (+1).
        length: (n,) of a run-up, as in `plan_move`.
    """
    least = run_up_lengths(arm)
    length = least if length is None else np.maximum(least, length)
    rooms = np.stack([_room(arm, q, side) for side in (-1.0, 1.0)], axis=-1)
    share = np.where(rooms >= least[:, None], np.minimum(rooms / length[:, None], 1.0), 0.0)
    forward = np.ones(len(q), bool) if start is None else q > start
    forward = np.where(np.equal(sure, 0.0), forward, np.greater(sure, 0.0))
    joints, natural = np.arange(len(q)), forward.astype(int)
    usable = known * share
    # A side that is so many times better is worth a longer way
    better = usable[joints, 1 - natural] > 3.0 * usable[joints, natural]
    return np.where(better ^ forward, 1.0, -1.0)
