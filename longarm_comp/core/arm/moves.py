"""Commands are moves: the side from which every joint arrives, and the run-up that it needs."""

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE


@dataclass(frozen=True, eq=False)
class Move:
    """A motion of the joints to a command."""

    q: np.ndarray  # (n,) joint values of the command (rad, m)
    run_up: np.ndarray | None  # (n,) where the last approach begins; None: no run-up is needed
    side: np.ndarray  # (n,) of -1, 0, +1: the side from which each joint arrives; 0: it stays
    doubtful: np.ndarray  # (n,) bool: joints that need a run-up and have no room for it

    @property
    def points(self) -> np.ndarray:
        """The way-points to send, (1, n), or (2, n) with a run-up, rad and m."""
        return self.q[None] if self.run_up is None else np.stack([self.run_up, self.q])


def run_up_lengths(arm: Arm) -> np.ndarray:
    """Return the (n,) shortest run-up of every joint (rad, m): longer than most joints' play."""
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
    """Return a move that arrives at q from the wanted sides, inside the limits.

    A joint goes to q without a run-up if the direct motion arrives from the wanted side, is at
    least `run_up_lengths` long and, together with the displacement before it in the same
    direction, at least as long as a run-up.  A joint that has no room for the shortest run-up also
    goes directly and is marked `doubtful`.  While other joints run up, joints without a run-up
    stop a little before q, so that they too arrive from their side.

    Args:
        start: (n,) where the joints stand, rad and m; None if this is not known.
        q: (n,) joint values of the command.
        wanted: (n,) of -1, 0, +1; 0: any side.
        length: (n,) wanted length of a run-up (rad, m), which limits may shorten; by default the
            shortest.
        leg: (n,) signed displacement (rad, m) of every joint at ``start`` since its last
            reversal; 0: not known.
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
    """Return the (n,) longest run-up (rad, m) to q that the limits allow from given sides (+-1)."""
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

    It is the side at which the effects are surest (`sure`), else the side of the direct motion. The
    other side is chosen if it is more than three times better. A side is rated by the product of
    its weight in the data (`known`) and the fraction of a run-up for which it has room.

    Args:
        start, q: as in `plan_move`.
        known: (n, 2) weights of the data on arrivals from above (-1) and from below (+1).
        sure: (n,) sides at which the effects are surest; 0: either.
        length: (n,) wanted length of a run-up, as in `plan_move`.
    """
    least = run_up_lengths(arm)
    length = least if length is None else np.maximum(least, length)
    rooms = np.stack([_room(arm, q, side) for side in (-1.0, 1.0)], axis=-1)
    share = np.where(rooms >= least[:, None], np.minimum(rooms / length[:, None], 1.0), 0.0)
    forward = np.ones(len(q), bool) if start is None else q > start
    forward = np.where(np.equal(sure, 0.0), forward, np.greater(sure, 0.0))
    joints, natural = np.arange(len(q)), forward.astype(int)
    usable = known * share
    # A side that is this many times better is worth a longer motion
    better = usable[joints, 1 - natural] > 3.0 * usable[joints, natural]
    return np.where(better ^ forward, 1.0, -1.0)
