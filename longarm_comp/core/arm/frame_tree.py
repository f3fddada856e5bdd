"""Frames by name with their poses in the parent frame over the last 10 s, as tf publishes them.

Between two published poses the position is interpolated linearly and the orientation by slerp.
Nothing is extrapolated.
"""

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

from longarm_comp.core.arm import quaternion
from longarm_comp.core.errors import InputError, LongarmError


class UnknownPlace(LongarmError):  # noqa: N818
    """The pose of a frame in another one is not known at that time; the message says why."""


class NotYet(UnknownPlace):
    """The last published pose is older than the requested time."""


@dataclass
class _Child:
    """The poses of a frame in its parent frame."""

    parent: str
    static: bool
    times: list[int] = field(default_factory=list)  # ns, ascending
    places: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Position (m) and quaternion x, y, z, w at each time."""

    def store(self, t_ns: int, place: tuple[np.ndarray, np.ndarray]) -> None:
        """Store a pose (m; x, y, z, w) at a time (ns), and delete poses more than 10 s older.

        If the time is more than 10 s before the latest one, all stored poses are deleted.
        """
        kept = round(1e9 * 10.0)  # how long poses are kept, ns
        if self.static or (self.times and t_ns < self.times[-1] - kept):  # the clock jumped back
            self.times, self.places = [], []
        k = bisect_left(self.times, t_ns)
        same = k < len(self.times) and self.times[k] == t_ns
        self.times[k : k + same], self.places[k : k + same] = [t_ns], [place]
        old = bisect_left(self.times, self.times[-1] - kept)
        del self.times[:old], self.places[:old]

    def at(self, name: str, t_ns: int) -> np.ndarray:
        """Return the pose (4, 4) in the parent frame at a time (ns); errors quote its `name`."""
        if self.static:
            return quaternion.compute_pose(*self.places[0])
        if t_ns > self.times[-1]:
            late = 1e-9 * (t_ns - self.times[-1])
            raise NotYet(f"frame {name!r} was last published {late:.2f} s before")
        if t_ns < self.times[0]:
            early = 1e-9 * (self.times[0] - t_ns)
            raise UnknownPlace(f"frame {name!r} is known only from {early:.2f} s later on")
        k = bisect_left(self.times, t_ns)
        if self.times[k] == t_ns:
            return quaternion.compute_pose(*self.places[k])
        (p, turn), (p_next, turn_next) = self.places[k - 1 : k + 1]
        share = (t_ns - self.times[k - 1]) / (self.times[k] - self.times[k - 1])
        place = p + share * (p_next - p)
        return quaternion.compute_pose(place, quaternion.interpolate(turn, turn_next, share))


class FrameTree:
    """The frames that tf published, by name."""

    def __init__(self) -> None:
        self._children: dict[str, _Child] = {}

    @property
    def names(self) -> list[str]:
        """The names of all known frames, including parents, sorted."""
        parents = {child.parent for child in self._children.values()}
        return sorted(parents | set(self._children))

    def hear(
        self,
        parent: str,
        child: str,
        position: np.ndarray,
        turn: np.ndarray,
        t_ns: int,
        *,
        static: bool = False,
    ) -> None:
        """Store a published pose of frame `child` in frame `parent`.

        Args:
            position: (3,) m.
            turn: quaternion (4,), x, y, z, w.
            t_ns: time of the pose, ns.
            static: the pose holds at all times.

        Raises:
            InputError: the pose is invalid, or `parent` depends on `child`.
        """
        if not np.isfinite(position).all():
            raise InputError("tf", f"position of {child}", position.tolist(), "finite numbers, m")
        if not quaternion.is_unit(turn):
            raise InputError("tf", f"rotation of {child}", turn.tolist(), "a unit quaternion")
        if parent == child or child in self._line(parent):
            raise InputError("tf", "parent", parent, f"a frame that does not depend on {child!r}")
        known = self._children.get(child)
        if known is None or known.parent != parent or known.static != static:
            known = self._children[child] = _Child(parent, static)
        known.store(t_ns, (np.asarray(position), np.asarray(turn) / np.linalg.norm(turn)))

    def place(self, frame: str, within: str, t_ns: int) -> np.ndarray:
        """Return the pose (4, 4) of `frame` in the frame `within` at a time.

        Args:
            t_ns: time, ns; 0: the latest time for which all frames between the two are known.

        Raises:
            UnknownPlace: a frame is unknown, the two are not connected, or the time is too early.
            NotYet: the last published pose of a frame between them is older.
        """
        lines = {name: self._line(name) for name in (frame, within)}
        for name, line in lines.items():
            if len(line) == 1 and name not in self.names:
                raise UnknownPlace(f"frame {name!r} is unknown")
        shared = [name for name in lines[frame] if name in lines[within]]
        if not shared:
            raise UnknownPlace(f"no tf connects frame {frame!r} with {within!r}")
        ways = [line[: line.index(shared[0])] for line in (lines[frame], lines[within])]
        if not t_ns:
            told = [self._children[name] for way in ways for name in way]
            t_ns = min((child.times[-1] for child in told if not child.static), default=0)
        up, down = np.eye(4), np.eye(4)
        for name in ways[0]:
            up = self._children[name].at(name, t_ns) @ up
        for name in ways[1]:
            down = self._children[name].at(name, t_ns) @ down
        return np.asarray(np.linalg.inv(down) @ up)

    def hangs_on(self, frame: str, other: str) -> bool:
        """Tell whether `other` is the frame itself or one of its parents, up to the root."""
        return other in self._line(frame)

    def _line(self, name: str) -> list[str]:
        """Return the names of a frame, its parent, and so on up to the root."""
        line = [name]
        while (child := self._children.get(line[-1])) is not None:
            line.append(child.parent)
        return line


def turned_covariance(pose: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Rotate a covariance (6, 6) of position and rotation from a frame to its parent.

    `pose` (4, 4) is that of the frame in the parent.
    """
    turn = np.kron(np.eye(2), pose[:3, :3])
    return np.asarray(turn @ covariance @ turn.T)


def carry_place(pose: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Transform points (..., 3), m, or poses (..., 4, 4) by the `pose` of their frame (4, 4)."""
    if target.shape[-2:] == (4, 4):
        return np.asarray(pose @ target)
    return np.asarray(target @ pose[:3, :3].T + pose[:3, 3])
