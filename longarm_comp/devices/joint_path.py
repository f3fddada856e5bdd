"""A smooth path through joint way-points that keeps velocity limits: cubic Hermite segments."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.math.shaper import Shaper

_WHERE = "joint trajectory"


@dataclass(frozen=True)
class _WayPoints:
    """Checked way-points of all joints: times (k,) s, positions and velocities (k, n)."""

    times: Array
    positions: Array
    velocities: Array | None


def checked(trajectory: JointTrajectory, config: ServoConfig, start: Array) -> _WayPoints | None:
    """Way-points in the order of ``config``; joints not named stay at ``start`` (n,).

    Returns None for a trajectory without points.
    """
    if not trajectory.points:
        return None
    columns = _columns(trajectory.joint_names, tuple(config.joints))
    with_velocities = [p for p in trajectory.points if p.velocities]
    if with_velocities and len(with_velocities) != len(trajectory.points):
        raise InputError(
            _WHERE,
            "velocities",
            f"{len(with_velocities)} of {len(trajectory.points)} points",
            "at every point or at none",
        )
    times = _times(trajectory)
    positions = np.tile(start, (len(times), 1))
    velocities = np.zeros_like(positions)
    for k, point in enumerate(trajectory.points):
        positions[k, columns] = _row(trajectory, k, "positions", point.positions)
        if with_velocities:
            velocities[k, columns] = _row(trajectory, k, "velocities", point.velocities)
    _within_limits(positions, config)
    return _WayPoints(times, positions, velocities if with_velocities else None)


def _columns(names: tuple[str, ...], known: tuple[str, ...]) -> list[int]:
    for k, name in enumerate(names):
        if name not in known:
            raise InputError(_WHERE, f"joint_names[{k}]", name, "one of " + ", ".join(known))
        if name in names[:k]:
            raise InputError(_WHERE, f"joint_names[{k}]", name, "each joint once")
    if not names:
        raise InputError(_WHERE, "joint_names", "none", "at least one of " + ", ".join(known))
    return [known.index(name) for name in names]


def _times(trajectory: JointTrajectory) -> Array:
    times = np.array([point.time_from_start_s for point in trajectory.points], dtype=float)
    for k, time in enumerate(times.tolist()):
        field = f"points[{k}].time_from_start"
        if not 0.0 <= time < 1e6:
            raise InputError(_WHERE, field, time, "0 to 1e6 s")
        if k and time <= times[k - 1]:
            raise InputError(
                _WHERE, field, time, f"later than {times[k - 1]:g} s, the point before"
            )
    return times


def _row(trajectory: JointTrajectory, k: int, field: str, values: tuple[float, ...]) -> Array:
    names = trajectory.joint_names
    if len(values) != len(names):
        raise InputError(
            _WHERE, f"points[{k}].{field}", f"{len(values)} values", f"{len(names)} values"
        )
    row = np.array(values, dtype=float)
    for name, value in zip(names, row.tolist(), strict=True):
        if not np.isfinite(value):
            raise InputError(_WHERE, f"points[{k}].{field} of {name}", value, "a finite number")
    return row


def _within_limits(positions: Array, config: ServoConfig) -> None:
    for column, (name, joint) in enumerate(config.joints.items()):
        for k, value in enumerate(positions[:, column].tolist()):
            joint.check_inside(value, _WHERE, f"points[{k}].positions of {name}")


Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TrajectoryPoint:
    """One way-point: seconds from the start, positions (rad, m) and perhaps velocities."""

    time_from_start_s: float
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()


@dataclass(frozen=True)
class JointTrajectory:
    """Way-points of named joints, as ``trajectory_msgs/JointTrajectory`` has them."""

    joint_names: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]


@dataclass(frozen=True)
class JointPath:
    """Cubic Hermite path.

    Attributes:
        times: (k,) s, from 0, increasing.
        positions: (k, n) rad or m.
        slopes: (k, n) rad/s or m/s at the knots.
        stretch: factor by which it was slowed to keep the velocity limits; 1 if it was not.
    """

    times: Array
    positions: Array
    slopes: Array
    stretch: float = 1.0

    @property
    def duration(self) -> float:
        """s"""
        return float(self.times[-1])

    @property
    def end(self) -> Array:
        """(n,) final position."""
        return self.positions[-1]

    def at(self, time_s: npt.ArrayLike) -> Array:
        """(..., n) positions at times (...); constant before the start and after the end."""
        t = np.clip(time_s, 0.0, self.times[-1])[..., None]
        k = np.searchsorted(self.times[1:-1], t[..., 0], side="right")
        if len(self.times) == 1:
            return self.positions[k]
        h = (self.times[k + 1] - self.times[k])[..., None]
        u = (t - self.times[k][..., None]) / h
        p, m, n = self.positions[k], self.slopes[k], self.slopes[k + 1]
        step = self.positions[k + 1] - p
        return p + h * m * u + (3 * step - h * (2 * m + n)) * u**2 + (h * (m + n) - 2 * step) * u**3

    def extremes(self) -> tuple[Array, Array]:
        """Lowest and highest position on the path, (n,) each."""
        if len(self.times) == 1:
            return self.positions[0], self.positions[0]
        h = np.diff(self.times)[:, None]
        b, c = self._velocity_terms()
        m = self.slopes[:-1]
        # Turning points: m + b u + c u^2 = 0 with the stable form of the quadratic formula.
        root = np.sqrt(np.maximum(b**2 - 4 * c * m, 0.0))
        half = -0.5 * (b + np.where(b < 0, -root, root))
        with np.errstate(divide="ignore", invalid="ignore"):
            turns = np.stack((half / c, m / half))
        turns = np.clip(np.where(np.isfinite(turns), turns, 0.0), 0.0, 1.0)
        reached = self.positions[:-1] + h * (m * turns + b * turns**2 / 2 + c * turns**3 / 3)
        every = np.concatenate((self.positions[None], reached), axis=None).reshape(
            -1, self.positions.shape[1]
        )
        return every.min(axis=0), every.max(axis=0)

    def peak_velocity(self) -> Array:
        """(n,) highest speed on the path."""
        if len(self.times) == 1:
            return np.zeros(self.positions.shape[1])
        b, c = self._velocity_terms()
        m = self.slopes[:-1]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = -b / (2 * c)
        inside = (u > 0.0) & (u < 1.0)
        u = np.where(inside, u, 0.0)
        return np.maximum(np.abs(self.slopes).max(axis=0), np.abs(m + b * u + c * u**2).max(axis=0))

    def _velocity_terms(self) -> tuple[Array, Array]:
        """Velocity in a segment is ``slope + b u + c u^2``, u from 0 to 1."""
        chord = np.diff(self.positions, axis=0) / np.diff(self.times)[:, None]
        m, n = self.slopes[:-1], self.slopes[1:]
        return 6 * chord - 4 * m - 2 * n, 3 * (m + n) - 6 * chord


@dataclass(frozen=True)
class TakenOver:
    """A path taken up in the middle of a motion: at first it is blended with braking.

    Both lie within the joint box, so their blend does; position and velocity are continuous.

    Attributes:
        path: what is followed after the blend.
        start, speed: (n,) set-point and its velocity at the take-over; rad or m, and a second.
        blend_s: duration of the blend, s.
        lower, upper: (n,) the joint box.
    """

    path: JointPath
    start: Array
    speed: Array
    blend_s: float
    lower: Array
    upper: Array

    def at(self, time_s: npt.ArrayLike) -> Array:
        """(..., n) positions at times (...) after the take-over."""
        t = np.asarray(time_s, float)[..., None]
        u = np.clip(t / self.blend_s, 0.0, 1.0)
        brake = np.clip(self.start + self.speed * t * (1.0 - 0.5 * u), self.lower, self.upper)
        weight = u * u * (3.0 - 2.0 * u)
        wanted = (1.0 - weight) * brake + weight * self.path.at(time_s)
        return np.clip(wanted, self.lower, self.upper)

    @property
    def duration(self) -> float:
        """s"""
        return self.path.duration

    @property
    def looked_at(self) -> Array:
        """(N,) s, sorted: 16 times in the blend, and 16 from one way-point to the next."""
        knots = [(0.0, self.blend_s), *pairwise(self.path.times.tolist())]
        # Each piece is looked at in 16 places
        return np.sort([np.linspace(a, b, 16 + 1)[1:] for a, b in knots], axis=None)

    def postures(self) -> Array:
        """(N, n) joints on the way."""
        return self.at(self.looked_at)


@dataclass(frozen=True)
class InParts:
    """A path from rest, sent in parts so that the arm does not ring at its end.

    The joints are at a mean of where the parts have them: inside the joint box and the limits of
    velocity, and on the path where it is straight.
    """

    way: TakenOver
    shaper: Shaper

    @property
    def path(self) -> JointPath:
        """What is followed."""
        return self.way.path

    @property
    def duration(self) -> float:
        """s"""
        return self.way.duration + self.shaper.duration

    def at(self, time_s: npt.ArrayLike) -> Array:
        """(..., n) positions at times (...)."""
        times = np.asarray(time_s, float)
        shaped = self.shaper.shaped(self.way.at, self.way.duration)
        return shaped(times.ravel()).reshape(*times.shape, -1)

    def postures(self) -> Array:
        """(N, n) joints on the way, as those of the path itself, of every part."""
        begins, ends = self.shaper.begins, self.shaper.ends
        paces = 1.0 + (ends - begins) / self.way.duration
        return self.at(np.unique(np.outer(self.way.looked_at, paces) + begins))


def plan_path(
    start: Array, times: Array, positions: Array, velocities: Array | None, max_velocity: Array
) -> JointPath:
    """A path from rest at ``start`` through the way-points to rest, within the velocity limits.

    Segments whose mean velocity is too high are lengthened. Then all segments are lengthened by
    one factor until the peak velocity is allowed. If the first point has time 0 and differs from
    ``start``, it is reached at the velocity limit. Without given velocities the slopes are those
    of Fritsch and Butland (1984). They are monotone between way-points, so the path stays in the
    box that the way-points span.

    Args:
        start: (n,). times: (k,) s, increasing, from 0 or later. positions, velocities: (k, n).
        max_velocity: (n,).
    """
    away = float(np.max(np.abs(positions[0] - start) / max_velocity))
    points, requested = positions, np.diff(times)
    if away > 1e-9 or times[0] > 1e-9:
        points = np.concatenate((start[None], positions))
        requested = np.diff(times, prepend=0.0)
    least = np.max(np.abs(np.diff(points, axis=0)) / max_velocity, axis=1)
    steps = np.maximum(requested, least)
    knots = np.concatenate(([0.0], np.cumsum(steps)))
    slopes = _monotone_slopes(knots, points)
    if velocities is not None:
        ratio = np.minimum(
            np.divide(requested, steps, out=np.ones_like(steps), where=steps > 0.0), 1.0
        )
        inner = np.minimum(ratio[:-1], ratio[1:])[:, None]
        slopes[1:-1] = velocities[-1 - len(inner) : -1] * inner
    path = JointPath(knots, points, slopes)
    slower = max(1.0, float(np.max(path.peak_velocity() / max_velocity)))
    expected = max(float(times[-1]), 1.5 * away)
    stretch = max(path.duration * slower / expected, 1.0) if expected > 0.0 else 1.0
    return JointPath(knots * slower, points, slopes / slower, stretch)


def _monotone_slopes(times: Array, positions: Array) -> Array:
    """Fritsch-Butland slopes, zero at both ends and wherever the direction turns."""
    slopes = np.zeros_like(positions)
    if len(times) < 3:
        return slopes
    h = np.diff(times)[:, None]
    chord = np.diff(positions, axis=0) / h
    before, after = chord[:-1], chord[1:]
    weight = (h[:-1] + 2 * h[1:]) / (3 * (h[:-1] + h[1:]))
    same = before * after > 0.0
    bottom = np.where(same, weight * after + (1 - weight) * before, 1.0)
    slopes[1:-1] = np.where(same, before * after / bottom, 0.0)
    return slopes
