"""Bags as a robot records them, message by message, for tests of reading."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from small_arm import ARM

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.bag import read_bag
from longarm_comp.sessions.message_types import message_types

STORAGES = ("mcap", "sqlite3")


@contextmanager
def robot(path: Path, namespace: str = "") -> Iterator[Any]:
    """Write a bag as a recorder does: `put(topic, type, seconds, message)`."""
    types = message_types()
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def put(topic: str, kind: str, t: float, **fields: Any) -> None:
            name = f"{namespace}/{topic}"
            if name not in connections:
                connections[name] = writer.add_connection(name, kind, typestore=types)
            message = types.types[kind](**fields)
            stamp = round((1000 + t) * 1e9)
            writer.write(connections[name], stamp, types.serialize_cdr(message, kind))

        yield put


def header(t: float = 0.0, frame: str = "base") -> Any:
    """A header, stamped so many seconds after the beginning; not stamped at 0."""
    types = message_types().types
    nanos = round((1000 + t) * 1e9) if t else 0
    stamp = types["builtin_interfaces/msg/Time"](sec=nanos // 10**9, nanosec=nanos % 10**9)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def command(
    put: Any,
    t: float,
    *points: list[float],
    names: tuple[str, ...] | None = None,
    stamp: float = 0.0,
) -> None:
    """Command the arm through these points, a second apart."""
    types = message_types().types
    none = np.array([])
    made = [
        types["trajectory_msgs/msg/JointTrajectoryPoint"](
            positions=np.array(p, dtype=float),
            velocities=none,
            accelerations=none,
            effort=none,
            time_from_start=types["builtin_interfaces/msg/Duration"](sec=k, nanosec=0),
        )
        for k, p in enumerate(points)
    ]
    names = ARM.joint_names if names is None else names
    kind = "trajectory_msgs/msg/JointTrajectory"
    put("joint_trajectory", kind, t, header=header(stamp), joint_names=list(names), points=made)


def asked(put: Any, t: float, q: np.ndarray, target: np.ndarray, refused: str = "") -> None:
    """The story of a target, as `kinematics` tells it."""
    types = message_types().types
    kind = "longarm_interfaces/msg/Compensation"

    def blank(name: str) -> Any:
        """A message of a type, everything in it zero or empty."""
        if name == "std_msgs/msg/Header":
            return header(t)
        if name == "geometry_msgs/msg/Point":
            return types[name](*map(float, target))
        made: dict[str, Any] = {}
        fields: Any = message_types().get_msgdef(name).fields
        for field, (node, inner) in fields:
            if node == 2:
                made[field] = blank(inner)
            elif node > 2:
                made[field] = [] if inner[0][0] == 2 or inner[0][1][0] == "string" else np.array([])
            else:
                made[field] = "" if inner[0] == "string" else 0
        return types[name](**made)

    story = {f: getattr(blank(kind), f) for f, _ in message_types().get_msgdef(kind).fields}
    story |= {"accepted": not refused, "message": refused}
    story["executed"].position = np.array([]) if refused else q
    put("compensation", kind, t, **story)


def row_said(put: Any, t: float, **row: Any) -> None:
    """What `collect` says of a visit."""
    put("session_row", "std_msgs/msg/String", t, data=json.dumps(row))


def state(
    put: Any, t: float, q: list[float], late: float = 0.0, known: tuple[str, ...] = ARM.joint_names
) -> None:
    """The joints as read back at t, in another order and with one that is not the arm's."""
    none = np.array([])
    names = [*reversed(known), "gripper"]
    position = np.array([*reversed(q), 0.3])
    kind = "sensor_msgs/msg/JointState"
    put(
        "joint_states", kind, t + late, header=header(t), name=names, position=position,
        velocity=none, effort=none,
    )  # fmt: skip


def sighting(
    put: Any,
    t: float,
    xyz: list[float],
    sd: float = 0.0,
    frame: str = "base",
    turn: Any = (0.0, 0.0, 0.0, 1.0),
    turn_sd: float = 0.0,
    topic: str = "tip_measured",
) -> None:
    """The tip as measured, with so large a standard deviation in every direction, m and rad."""
    types = message_types().types
    x, y, z = map(float, xyz)
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = sd**2
    covariance[[21, 28, 35]] = turn_sd**2
    qx, qy, qz, qw = map(float, turn)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
        orientation=types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
    )
    whole = types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    put(topic, kind, t, header=header(t, frame), pose=whole)


def refusal(path: Path, **how: Any) -> str:
    """What is said of a bag that must be refused: one line that begins with its path."""
    with pytest.raises(InputError) as caught:
        read_bag(path, ARM, **how)
    message = str(caught.value)
    assert message.startswith(str(path)), message
    assert "\n" not in message, message
    return message
