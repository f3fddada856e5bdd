"""A luffing telescope crane as its own physics: rigid pieces on springs, in static balance.

Nothing of the package is imported.  Each spring turns its piece by compliance times the moment of
all that hangs beyond it; that is repeated until nothing moves.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

LOWER = np.array([np.radians(-60), np.radians(5), 0.0, np.radians(-40)])
UPPER = np.array([np.radians(60), np.radians(60), 2.0, np.radians(40)])
TABLE = (
    "d=1.2 limits=-60..60",
    "alpha=90 a=0.3 limits=5..60",
    "type=prismatic alpha=90 theta=90 d=3.2 limits=0..2",
    "alpha=-90 limits=-40..40",
)
"""The drawing: DH rows, as `longarm init --joint` takes them; the tip is at `TIP`."""
TIP = (0.2, 0.05, 0.1)
_OUTER_M, _INNER_M = 3.0, 2.6  # lengths of the boom's two parts


def _moved(turn: np.ndarray, by: tuple[float, float, float]) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = turn, by
    return made


def _row(alpha: float, a: float, theta: float, d: float) -> np.ndarray:
    first = _moved(Rotation.from_euler("x", alpha).as_matrix(), (a, 0.0, 0.0))
    return first @ _moved(Rotation.from_euler("z", theta).as_matrix(), (0.0, 0.0, d))


@dataclass
class _Piece:
    pose: np.ndarray  # from the piece before, unbent
    compliance: np.ndarray  # about its x, y, z, rad/(N m)
    mass: float = 0.0
    middle: np.ndarray = field(default_factory=lambda: np.zeros(3))


class Crane:
    """The true crane, drawn by a seed; `gear` (rad): its luffing gear sits eccentric."""

    def __init__(self, seed: int, gear: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.gear, self.phase = gear, rng.uniform(-3, 3)
        self.zero, self.twist = rng.normal(0, 4e-3, 4), rng.normal(0, 2e-3, 4)
        self.zero[2] = rng.normal(0, 2e-3)
        self.a, self.d = rng.normal(0, 1.5e-3, 4), rng.normal(0, 1.5e-3, 4)
        self.tip = np.array(TIP) + rng.normal(0, 2e-3, 3)
        own = 1.0 / np.array([4e5, 2.5e5, 1e12, 3e4]) * np.exp(rng.normal(0, 0.4, 4))
        across = 1.0 / np.array([8e5, 8e5, 1e12, 1e5]) * np.exp(rng.normal(0, 0.4, 4))
        self.compliance = np.stack([across, across, own], axis=1)
        self.outer_nm2 = rng.uniform(1.2e6, 2.5e6)
        turn = Rotation.from_rotvec([*rng.normal(0, 0.01, 2), rng.uniform(-3, 3)])
        self.base = _moved(turn.as_matrix(), tuple(rng.normal(0, 1.0, 3)))

    def at(self, q: np.ndarray) -> np.ndarray:
        """(3,) the tip in the tracker's frame, m."""
        pieces = self._pieces(np.asarray(q, float) + self.zero)
        masses = np.array([p.mass for p in pieces])
        bends = [np.eye(4)] * len(pieces)
        for _ in range(6):
            frames, frame = [], np.eye(4)
            for piece, bend in zip(pieces, bends, strict=True):
                frame = frame @ piece.pose @ bend
                frames.append(frame)
            middles = np.array(
                [f[:3, :3] @ p.middle + f[:3, 3] for f, p in zip(frames, pieces, strict=True)]
            )
            made = []
            for k, (piece, bend) in enumerate(zip(pieces, bends, strict=True)):
                weights = masses[k:, None] * np.array([0.0, 0.0, -9.81])
                moment = np.cross(middles[k:] - frames[k][:3, 3], weights).sum(axis=0)
                unbent = frames[k][:3, :3] @ bend[:3, :3].T
                turn = Rotation.from_rotvec(piece.compliance * (unbent.T @ moment))
                made.append(_moved(turn.as_matrix(), (0.0, 0.0, 0.0)))
            bends = made
        frame = self.base @ frames[-1]
        return frame[:3, :3] @ self.tip + frame[:3, 3]

    def drawn(self, q: np.ndarray) -> np.ndarray:
        """(3,) the tip in the tracker's frame if the crane were as drawn, m."""
        frame = self.base @ _row(0, 0, q[0], 1.2) @ _row(np.pi / 2, 0.3, q[1], 0.0)
        frame = frame @ _row(np.pi / 2, 0, np.pi / 2, 3.2 + q[2]) @ _row(-np.pi / 2, 0, q[3], 0.0)
        return frame[:3, :3] @ TIP + frame[:3, 3]

    def _pieces(self, x: np.ndarray) -> list[_Piece]:
        luff = x[1] + self.gear * np.sin(x[1] + self.phase)
        long = 3.2 + self.d[2] + x[2]
        twist, still = self.twist, np.zeros(3)
        made = [
            _Piece(_row(twist[0], self.a[0], x[0], 1.2 + self.d[0]), self.compliance[0]),
            _Piece(_row(np.pi / 2 + twist[1], 0.3 + self.a[1], luff, self.d[1]),
                   self.compliance[1]),
            _Piece(_row(np.pi / 2 + twist[2], self.a[2], np.pi / 2, 0.0), still),
        ]  # fmt: skip
        cuts = [*np.linspace(0.0, _OUTER_M, 13), *np.linspace(_OUTER_M, long, 9)[1:]]
        for k, (begin, end) in enumerate(pairwise(cuts)):
            inside = max(0.0, end - max(begin, long - _INNER_M))
            mass = 50.0 / _INNER_M * inside + (90.0 / 12 if k < 12 else 0.0)
            soft = (end - begin) / self.outer_nm2 * (1.0 if k < 12 else 2.0)
            middle = np.array([0.0, 0.0, (begin - end) / 2])
            pose = _moved(np.eye(3), (0.0, 0.0, end - begin))
            made.append(_Piece(pose, soft * np.array([1.0, 1.0, 0.3]), mass, middle))
        head = _row(-np.pi / 2 + twist[3], self.a[3], x[3], self.d[3])
        return [*made, _Piece(head, self.compliance[3], 37.0, 0.6 * self.tip)]
