"""Checks a joint trajectory and puts it into the order of the arm's joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.devices.joint_path import Array, JointTrajectory
from longarm_comp.devices.servo_config import ServoConfig

_WHERE = "joint trajectory"


@dataclass(frozen=True)
class WayPoints:
    """Checked way-points of all joints: times (k,) s, positions and velocities (k, n)."""

    times: Array
    positions: Array
    velocities: Array | None


def checked(trajectory: JointTrajectory, config: ServoConfig, start: Array) -> WayPoints | None:
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
    return WayPoints(times, positions, velocities if with_velocities else None)


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
        slack = 0.5 * joint.si_per_tick
        for k, value in enumerate(positions[:, column].tolist()):
            if not joint.lower - slack <= value <= joint.upper + slack:
                allowed = f"{joint.lower:g} to {joint.upper:g} {joint.unit}"
                raise InputError(_WHERE, f"points[{k}].positions of {name}", value, allowed)
