"""A smooth path through joint way-points that keeps velocity limits: cubic Hermite segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from longarm_comp.core.errors import InputError
from longarm_comp.devices.follower_report import Accepted
from longarm_comp.devices.servo_config import FollowerConfig, ServoConfig
from longarm_comp.math.cubic_path import STRAIGHT, Array, CubicPath, monotone_slopes
from longarm_comp.math.shaper import Shaper

_WHERE = "joint trajectory"
_MOST_POINTS = 1000
"""Largest number of points after time 0. The driver does nothing else while it processes them, 25
us each."""


def check_trajectory(
    trajectory: JointTrajectory, config: ServoConfig, start: Array
) -> tuple[Array, Array, Array | None]:
    """Check a trajectory of at least one point and return its way-points for all n joints.

    Args:
        start: (n,) rad and m: where joints stay that the trajectory does not name.

    Returns:
        Times (k,), s; positions (k, n), rad and m, within the limits; and velocities (k, n), or
        None if it has none. Joints are in the order of ``config``.

    Raises:
        InputError: naming the field that is not allowed.
    """
    if len(trajectory.points) > _MOST_POINTS + (trajectory.points[0].time_from_start_s == 0.0):
        found = f"{len(trajectory.points)} points"
        raise InputError(_WHERE, "points", found, f"{_MOST_POINTS} at most, cubic in between")
    names, known = trajectory.joint_names, tuple(config.joints)
    for k, name in enumerate(names):
        if name not in known:
            raise InputError(_WHERE, f"joint_names[{k}]", name, "one of " + ", ".join(known))
        if name in names[:k]:
            raise InputError(_WHERE, f"joint_names[{k}]", name, "each joint once")
    if not names:
        raise InputError(_WHERE, "joint_names", "none", "at least one of " + ", ".join(known))
    columns = [known.index(name) for name in names]
    with_velocities = [p for p in trajectory.points if p.velocities]
    if with_velocities and len(with_velocities) != len(trajectory.points):
        found = f"{len(with_velocities)} of {len(trajectory.points)} points"
        raise InputError(_WHERE, "velocities", found, "at every point or at none")
    times = np.array([point.time_from_start_s for point in trajectory.points], dtype=float)
    for k, time in enumerate(times.tolist()):
        field = f"points[{k}].time_from_start"
        if not 0.0 <= time < 1e6:
            raise InputError(_WHERE, field, time, "0 to 1e6 s")
        if k and time <= times[k - 1]:
            allowed = f"later than {times[k - 1]:g} s, the point before"
            raise InputError(_WHERE, field, time, allowed)
    positions = np.tile(start, (len(times), 1))
    velocities = np.zeros_like(positions)
    positions[:, columns] = _check_rows(trajectory, "positions")
    if with_velocities:
        velocities[:, columns] = _check_rows(trajectory, "velocities")
    for column, (name, joint) in zip(positions.T, config.joints.items(), strict=True):
        for k in (int(column.argmin()), int(column.argmax())):
            joint.check_inside(float(column[k]), _WHERE, f"points[{k}].positions of {name}")
        # Less than half a tick beyond a limit is the limit, where the motion ends
        np.clip(column, joint.lower, joint.upper, out=column)
    return times, positions, velocities if with_velocities else None


def _check_rows(trajectory: JointTrajectory, field: str) -> Array:
    names, rows = trajectory.joint_names, [getattr(point, field) for point in trajectory.points]
    for k, values in enumerate(rows):
        if len(values) != len(names):
            found = f"{len(values)} values"
            raise InputError(_WHERE, f"points[{k}].{field}", found, f"{len(names)} values")
    table = np.array(rows, dtype=float)
    for k, j in np.argwhere(~np.isfinite(table)).tolist():
        where = f"points[{k}].{field} of {names[j]}"
        raise InputError(_WHERE, where, float(table[k, j]), "a finite number")
    return table


@dataclass(frozen=True)
class TrajectoryPoint:
    """One way-point: time from the start, s, positions (rad, m) and optionally velocities."""

    time_from_start_s: float
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()


@dataclass(frozen=True)
class JointTrajectory:
    """Way-points of named joints, as ``trajectory_msgs/JointTrajectory`` has them."""

    joint_names: tuple[str, ...]
    points: tuple[TrajectoryPoint, ...]


@dataclass(frozen=True)
class TakenOver:
    """A path that begins during another motion: first, braking of this motion is blended with it.

    Both are within the joint limits, so the blend is too. Position and velocity are continuous.
    """

    path: CubicPath  # the path that is followed alone after the blend
    start: Array
    """start, speed: (n,) set-point (rad, m) and its velocity (rad/s, m/s) at the take-over."""
    speed: Array
    blend_s: float  # duration of the blend, s
    lower: Array  # lower, upper: (n,) joint limits, rad and m
    upper: Array

    def at(self, time_s: npt.ArrayLike) -> Array:
        """Return positions (..., n), rad and m, at times (...), s, after the take-over."""
        t = np.asarray(time_s, float)[..., None]
        u = np.clip(t / self.blend_s, 0.0, 1.0)
        brake = np.clip(self.start + self.speed * t * (1.0 - 0.5 * u), self.lower, self.upper)
        weight = u * u * (3.0 - 2.0 * u)
        wanted = (1.0 - weight) * brake + weight * self.path.at(time_s)
        return np.clip(wanted, self.lower, self.upper)

    @property
    def duration(self) -> float:
        """Duration of the path, s."""
        return self.path.duration

    @property
    def looked_at(self) -> Array:
        """Times (N,), s, sorted, from 0 on, between which the joints move nearly straight."""
        blend = np.linspace(0.0, self.blend_s, 16 + 1)
        return np.sort(np.concatenate((blend, self.path.chords(STRAIGHT))))

    def postures(self) -> Array:
        """Return joints (N, n) along the path, at the times `looked_at`."""
        return self.at(self.looked_at)


@dataclass(frozen=True)
class InParts:
    """A path from rest that is sent in delayed parts, so that the arm does not ring at its end.

    The position is a weighted mean of the parts. So it is within the limits of joints and velocity,
    and on the path where this is straight.
    """

    way: TakenOver
    shaper: Shaper

    @property
    def path(self) -> CubicPath:
        return self.way.path

    @property
    def duration(self) -> float:
        """Duration of the shaped path, s."""
        return self.way.duration + self.shaper.duration

    def at(self, time_s: npt.ArrayLike) -> Array:
        """Return positions (..., n), rad and m, at times (...), s, after the start."""
        times = np.asarray(time_s, float)
        shaped = self.shaper.shape_motion(self.way.at, self.way.duration)
        return shaped(times.ravel()).reshape(*times.shape, -1)

    def postures(self) -> Array:
        """Return joints (N, n) along the path, at the times `looked_at` of every part."""
        begins, ends = self.shaper.begins, self.shaper.ends
        paces = 1.0 + (ends - begins) / self.way.duration
        return self.at(np.unique(np.outer(self.way.looked_at, paces) + begins))


@dataclass
class Turn:
    """The end of a run-up, where some joints reverse.

    The time along the move stops there until these joints have arrived, at most for `patience_s`.
    No step skips this point, however late a cycle is.
    """

    time_s: float  # time of the point along the move, s
    joints: Array  # (n,) bool: the joints that reverse there
    patience_s: float  # longest wait, s
    waited_s: float = 0.0  # time waited so far, s

    def time_after(self, time_s: float, dt: float, have_come: Callable[[], bool]) -> float:
        """Return the time along the move, s, after a step of ``dt``, s, from ``time_s``.

        ``have_come``: called only at the end of the run-up; tells whether the joints that reverse
        have arrived.
        """
        if time_s > self.time_s or time_s + dt < self.time_s:
            return time_s + dt
        if time_s < self.time_s:
            return self.time_s
        self.waited_s += dt
        waits = self.waited_s < self.patience_s and not have_come()
        return time_s if waits else time_s + dt


def find_turn(accepted: Accepted, limits: FollowerConfig) -> Turn | None:
    """Return the end of a move's run-up; None if it has none, or one within the blend."""
    if len(accepted.times) != 2 or accepted.times[0] < limits.blend_s:
        return None
    legs = np.diff(accepted.points, axis=0, prepend=accepted.start[None])
    return Turn(float(accepted.times[0]), legs[0] * legs[1] < 0.0, limits.stall_time_s)


def plan_path(
    start: Array, times: Array, positions: Array, velocities: Array | None, max_velocity: Array
) -> CubicPath:
    """Plan from rest at ``start`` through the way-points to rest, within the velocity limits.

    Segments whose mean velocity is too high are lengthened. Then all segments are lengthened by one
    factor until the peak velocity is allowed. If the first point is at time 0 but not at ``start``,
    a segment at the velocity limit leads there.

    Args:
        start: (n,) rad and m.
        times: (k,) s, increasing, from 0 or later.
        positions: (k, n) rad and m.
        velocities: (k, n) rad/s and m/s at the way-points; None: `monotone_slopes`.
        max_velocity: (n,) rad/s and m/s.
    """
    away = float(np.max(np.abs(positions[0] - start) / max_velocity))
    points, requested = positions, np.diff(times)
    if away > 1e-9 or times[0] > 1e-9:
        points = np.concatenate((start[None], positions))
        requested = np.diff(times, prepend=0.0)
    least = np.max(np.abs(np.diff(points, axis=0)) / max_velocity, axis=1)
    steps = np.maximum(requested, least)
    knots = np.concatenate(([0.0], np.cumsum(steps)))
    slopes = monotone_slopes(knots, points)
    if velocities is not None:
        ratio = np.minimum(
            np.divide(requested, steps, out=np.ones_like(steps), where=steps > 0.0), 1.0
        )
        inner = np.minimum(ratio[:-1], ratio[1:])[:, None]
        slopes[1:-1] = velocities[-1 - len(inner) : -1] * inner
    path = CubicPath(knots, points, slopes)
    slower = max(1.0, float(np.max(path.peak_velocity() / max_velocity)))
    expected = max(float(times[-1]), 1.5 * away)
    stretch = max(path.duration * slower / expected, 1.0) if expected > 0.0 else 1.0
    return CubicPath(knots * slower, points, slopes / slower, stretch)
