"""Conversions between ROS messages and the arrays and records of the core.

Arrays (n,) are in the order of the arm's joints, rad (revolute) and m (prismatic).
"""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, TypeVar

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseWithCovarianceStamped,
    Quaternion,
    Vector3,
    Vector3Stamped,
    WrenchStamped,
)
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import name_tilt
from longarm_comp.core.arm.frame_tree import carry_place, turned_covariance
from longarm_comp.core.compensation.online import check_inside
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import position_of
from longarm_comp.core.yaml_file import range_of
from longarm_comp.devices import joint_path as devices
from longarm_comp.devices.servo_arm import ServoReading
from longarm_interfaces.msg import DriverState, Motion

FARTHEST = range_of("_m")[1]
STRONGEST = 1e6
"""Largest force (N) or torque (N m) of a sensor that is taken as possible."""
Message = TypeVar("Message")


def fill(blank: Message, **fields: Any) -> Message:
    """Return a copy of a message with new fields: faster than its class, which makes defaults."""
    made = copy(blank)
    for name, value in fields.items():
        setattr(made, name, value)
    return made


_JOINTS = JointState()


def pose_message(target: np.ndarray) -> Pose:
    """Make the message of a pose (4, 4), or of a position (3,) with the identity as orientation."""
    x, y, z = position_of(target).tolist()
    message = Pose(position=Point(x=x, y=y, z=z))
    if target.ndim == 2:
        message.orientation = quaternion_message(quaternion.from_rotation(target[:3, :3]))
    return message


def quaternion_message(turn: np.ndarray) -> Quaternion:
    """Make the message of a quaternion (x, y, z, w)."""
    x, y, z, w = turn.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def vector_message(values: Sequence[float] | np.ndarray) -> Vector3:
    x, y, z = (float(v) for v in values)
    return Vector3(x=x, y=y, z=z)


def error_message(error: Vector3, stamp: Time, frame: str) -> Vector3Stamped:
    """Make the message of a predicted error, m."""
    return Vector3Stamped(header=Header(stamp=stamp, frame_id=frame), vector=error)


def joints_message(arm: Arm, q: np.ndarray, stamp: Time | None = None) -> JointState:
    """Make a message of joints (n,), rad or m, with their names."""
    header = Header() if stamp is None else Header(stamp=stamp)
    position = np.asarray(q, float).tolist()
    return fill(_JOINTS, header=header, name=list(arm.joint_names), position=position)


def joints_of(message: JointState, arm: Arm, where: str) -> np.ndarray:
    """Return joint positions (n,) in the order of the arm, rad and m.

    Other joints of the message are ignored.

    Raises:
        InputError: a joint is missing, named twice or not finite; ``where`` names the source.
    """
    if len(message.name) != len(message.position):
        found = f"{len(message.name)} names, {len(message.position)} positions"
        raise InputError(where, "position", found, "one position a name")
    at, names = dict(zip(message.name, message.position, strict=True)), list(message.name)
    for name in arm.joint_names:
        if names.count(name) != 1:
            allowed = f"each of {', '.join(arm.joint_names)} once"
            raise InputError(where, "name", ", ".join(names), allowed)
        if not math.isfinite(at[name]):
            raise InputError(where, name, at[name], "a finite number, rad or m")
    return np.array([at[name] for name in arm.joint_names])


def efforts_of(message: JointState, arm: Arm) -> np.ndarray:
    """Return efforts (n,) of all joints, N m and N; NaN if missing or above `STRONGEST`."""
    if len(message.effort) != len(message.name):
        return np.full(arm.n, np.nan)
    at = dict(zip(message.name, message.effort, strict=True))
    told = np.array([at[name] for name in arm.joint_names])
    return np.where(np.abs(told) <= STRONGEST, told, np.nan)


def sides_of(approach: Sequence[int], names: Sequence[str], arm: Arm, where: str) -> np.ndarray:
    """Return the side (n,) that each joint arrives from, -1, 0 (unknown) or +1, in the arm's order.

    ``approach`` has one side per name, one for all joints, or none (all unknown).

    Raises:
        InputError: another value or number of sides; ``where`` names the source.
    """
    sides = [float(side) for side in approach]
    if any(side not in (-1.0, 0.0, 1.0) for side in sides):
        raise InputError(where, "approach", sides, "-1, 0 or +1")
    if len(sides) <= 1:
        return np.full(arm.n, sides[0] if sides else 0.0)
    if len(sides) != len(names):
        found = f"{len(names)} joints, {len(sides)} sides"
        raise InputError(where, "approach", found, "one side a joint, one for all, or none")
    at = dict(zip(names, sides, strict=True))
    return np.array([at[name] for name in arm.joint_names])


def path_of(message: JointTrajectory, arm: Arm) -> np.ndarray:
    """Return the way-points (k, n) of a trajectory in the order of the arm, rad and m.

    Raises InputError if there are none, or joints are missing or outside their limits.
    """
    where, names = "joint_trajectory", message.joint_names
    if not message.points:
        raise InputError(where, "points", 0, "at least one")
    rows = [JointState(name=names, position=point.positions) for point in message.points]
    path = np.array([joints_of(row, arm, where) for row in rows])
    for q in path:
        check_inside(q, arm, where)
    return path


def motion_of(message: Motion, arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Return start (n,) and way-points (k, n) of an accepted trajectory; raise as `path_of`."""
    start = joints_of(message.start, arm, "start of motion")
    check_inside(start, arm, "start of motion")
    way = JointTrajectory(joint_names=message.start.name, points=message.points)
    return start, path_of(way, arm)


def duration(value_s: float) -> Duration:
    """Return the message of a duration in s, which must be 0 or more."""
    whole, rest = divmod(round(value_s * 1e9), 10**9)
    return Duration(sec=whole, nanosec=rest)


def seconds(message: Duration) -> float:
    return float(message.sec + 1e-9 * message.nanosec)


def trajectory_message(
    arm: Arm,
    points: np.ndarray,
    times: float | np.ndarray,
    stamp: Time,
    velocities: np.ndarray | None = None,
) -> JointTrajectory:
    """Make the message of a trajectory through way-points (k, n), rad and m.

    Args:
        times: (k,) s after the start, or one number: a constant interval, s.
        velocities: (k, n) rad/s and m/s; None: left to the driver.
    """
    message = JointTrajectory(header=Header(stamp=stamp), joint_names=list(arm.joint_names))
    due = times * np.arange(1, len(points) + 1) if np.ndim(times) == 0 else np.asarray(times)
    message.points = points_message(points, due, velocities)
    return message


def points_message(
    points: np.ndarray, times: np.ndarray, velocities: np.ndarray | None = None
) -> list[JointTrajectoryPoint]:
    """Make the messages of way-points (k, n) at times (k,), s, with velocities (k, n) if given."""
    speeds = np.zeros((len(points), 0)) if velocities is None else velocities
    return [
        JointTrajectoryPoint(positions=q, velocities=v, time_from_start=duration(at))
        for q, v, at in zip(points.tolist(), speeds.tolist(), times.tolist(), strict=True)
    ]


def trajectory_of(message: JointTrajectory) -> devices.JointTrajectory:
    """Convert a trajectory to the record of the devices: it starts when it is accepted."""
    points = tuple(
        devices.TrajectoryPoint(seconds(p.time_from_start), tuple(p.positions), tuple(p.velocities))
        for p in message.points
    )
    return devices.JointTrajectory(tuple(message.joint_names), points)


def tilt_of(message: Imu) -> tuple[str, dict[str, float]]:
    """Return the frame of a tilt sensor, and its tilt (rad) by name of a session's column.

    Raises:
        InputError: the message holds no orientation, or no unit quaternion.
    """
    if message.orientation_covariance[0] < 0:
        where = "orientation_covariance[0]"
        raise InputError("inclination", where, "-1: no orientation", "a sensor that gives one")
    o = message.orientation
    turn = np.array([o.x, o.y, o.z, o.w])
    if not quaternion.is_unit(turn):
        raise InputError("inclination", "orientation", turn.tolist(), "a unit quaternion")
    frame = message.header.frame_id
    return frame or "0", name_tilt(frame, *quaternion.compute_tilt(turn))


def wrench_of(message: WrenchStamped, arm: Arm) -> tuple[int, np.ndarray]:
    """Return the row of arm.yaml in whose axes a wrist sensor measures, and its force (3,), N.

    Raises:
        InputError: no such row, or a force that is not finite or above `STRONGEST`.
    """
    name, f = message.header.frame_id, message.wrench.force
    rows = [str(row) for row in range(len(arm.joints) + 1)]
    if name not in rows:
        raise InputError("wrench", "frame_id", name, f"a row of arm.yaml: 0 to {rows[-1]}")
    force = np.array([f.x, f.y, f.z])
    if not (np.abs(force) <= STRONGEST).all():
        raise InputError("wrench", "force", force.tolist(), f"finite, up to {STRONGEST:g} N")
    return int(name), force


def sighting_of(message: PoseWithCovarianceStamped) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip (3,), m, and its variance (3,), m^2. The tip is NaN if the marker was lost."""
    p = message.pose.pose.position
    covariance = np.asarray(message.pose.covariance, dtype=float)
    return np.array([p.x, p.y, p.z]), covariance[[0, 7, 14]]


def check_sighting(tip: np.ndarray, variance: np.ndarray) -> None:
    """Refuse an impossible tip (3,), m, or variance (3,), m^2. A lost marker (NaN) is allowed.

    Raises:
        InputError: naming the position or the covariance.
    """
    if (np.abs(tip) > FARTHEST).any():
        raise InputError("tip_measured", "position", tip.tolist(), f"NaN, or up to {FARTHEST:g} m")
    sure = (variance >= 0.0) & (variance <= FARTHEST**2)
    if not sure.all() and not np.isnan(tip).any():
        allowed = f"0 to {FARTHEST**2:g} m^2"
        raise InputError("tip_measured", "covariance", variance.tolist(), allowed)


def tip_message(
    tip: np.ndarray, covariance: np.ndarray, stamp: Time, frame: str
) -> PoseWithCovarianceStamped:
    """Make the message of a tip (3,), m, with the covariance (6, 6) of its pose, m and rad."""
    message = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=frame))
    x, y, z = tip.tolist()
    message.pose.pose.position = Point(x=x, y=y, z=z)
    message.pose.covariance = covariance.ravel()
    return message


def express_sighting(
    message: PoseWithCovarianceStamped, place: np.ndarray, frame: str
) -> PoseWithCovarianceStamped:
    """Return a sighting expressed in ``frame``; its own frame is at ``place`` (4, 4), m, in it."""
    tip, o = sighting_of(message)[0], message.pose.pose.orientation
    turn = np.array([o.x, o.y, o.z, o.w])
    seen = quaternion.compute_pose(tip, turn) if quaternion.is_unit(turn) else tip
    covariance = np.reshape(message.pose.covariance, (6, 6))
    told = PoseWithCovarianceStamped(header=Header(stamp=message.header.stamp, frame_id=frame))
    told.pose.pose = pose_message(carry_place(place, seen))
    told.pose.covariance = turned_covariance(place, covariance).ravel()
    return told


_DRIVER_STATES = {
    DriverState.UNCONFIGURED: "not configured",
    DriverState.INACTIVE: "inactive: torque off",
    DriverState.READY: "ready",
    DriverState.MOVING: "moving",
    DriverState.HOLDING: "held: trajectories refused",
    DriverState.FAULT: "in fault: torque on, trajectories refused",
    DriverState.ESTOP: "stopped: trajectories refused",
}


def driver_words(state: int) -> str:
    return _DRIVER_STATES.get(state, f"in the unknown state {state}")


def readings_message(readings: Mapping[str, ServoReading], stamp: Time) -> JointState:
    """Make the message of the joints' read-back; with efforts if at least one is known."""
    joints = readings.values()
    efforts = [joint.effort for joint in joints]
    return JointState(
        header=Header(stamp=stamp),
        name=list(readings),
        position=[joint.position for joint in joints],
        velocity=[joint.velocity for joint in joints],
        effort=[] if all(map(math.isnan, efforts)) else efforts,
    )
