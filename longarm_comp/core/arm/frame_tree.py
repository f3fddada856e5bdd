"""Frames by name, each placed in its parent over the last seconds: what tf tells.

A place between two that were told is interpolated: its position on the straight line, its
orientation on the shortest turn. Nothing is extrapolated.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

from longarm_comp.core.arm import quaternion
from longarm_comp.core.errors import InputError, LongarmError


class UnknownPlace(LongarmError):  # noqa: N818
    """A frame's place in another one is not known at that time; the message says why."""


class NotYet(UnknownPlace):
    """The last published place is older than the time asked for."""


@dataclass
class _Child:
    """The places of a frame in its parent: times (ns, rising), positions (m) and x, y, z, w."""

    parent: str
    static: bool
    times: list[int] = field(default_factory=list)
    places: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def store(self, t_ns: int, place: tuple[np.ndarray, np.ndarray]) -> None:
        kept = round(1e9 * 10.0)  # How long places are kept, s
        if self.static or (self.times and t_ns < self.times[-1] - kept):  # the clock jumped back
            self.times, self.places = [], []
        k = bisect_left(self.times, t_ns)
        same = k < len(self.times) and self.times[k] == t_ns
        self.times[k : k + same], self.places[k : k + same] = [t_ns], [place]
        old = bisect_left(self.times, self.times[-1] - kept)
        del self.times[:old], self.places[:old]

    def at(self, name: str, t_ns: int) -> np.ndarray:
        """Return the pose (4, 4) in the parent at a time (ns)."""
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
    """Frames that were told, by name."""

    def __init__(self) -> None:
        self._children: dict[str, _Child] = {}

    @property
    def names(self) -> list[str]:
        """The names of every known frame, parents too, sorted."""
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
        """Take in where a frame is in its parent: (3,) m and x, y, z, w. Static: at all times."""
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
        """Return the pose (4, 4) of a frame in another one at a time (ns); 0: the latest of all.

        Raises `UnknownPlace`, or `NotYet` where what was last published is older.
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
        """Tell whether a frame is another one, or was placed, over its parents, in that one."""
        return other in self._line(frame)

    def _line(self, name: str) -> list[str]:
        """Return a frame, its parent, and so on to the root."""
        line = [name]
        while (child := self._children.get(line[-1])) is not None:
            line.append(child.parent)
        return line


def turned_covariance(pose: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return a frame's covariance (6, 6) of place and turn along the axes that its pose is in."""
    turn = np.kron(np.eye(2), pose[:3, :3])
    return np.asarray(turn @ covariance @ turn.T)


def carry_place(pose: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Express points (..., 3) or poses (..., 4, 4) of a frame in the frame in which its pose (4, 4)
    is given."""
    if target.shape[-2:] == (4, 4):
        return np.asarray(pose @ target)
    return np.asarray(target @ pose[:3, :3].T + pose[:3, 3])
