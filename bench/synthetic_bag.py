"""Synthetic robot recordings of any size, for the benchmarks of bags.

An arm is sent to a pose every 4 s, moves for 1 s and rests.  Joints are measured at 100 Hz with
speeds and efforts, the tip at 15 Hz while it rests.  The messages are serialised once and only
their numbers are replaced, so that generating a bag costs little compared with writing it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.message_buffer import TYPES
from longarm_comp.sessions.message_types import message_types

STATES_HZ, SIGHTINGS_HZ, MOVE_S, PERIOD_S = 100, 15, 1.0, 4.0
_START_NS = 1_000_000_000_000
_STAMP = struct.Struct("<iI")  # of the header, after the four bytes of CDR


class Raw(NamedTuple):
    """One serialised message."""

    topic: str
    stamp_ns: int
    data: bytes


def recording(arm: Arm, seed: int = 0) -> Iterator[Raw]:
    """Messages of an endless session, in the order of time."""
    rng, model, begin = np.random.default_rng(seed), Model(arm), _START_NS
    make, last = _Messages(arm), arm.mid
    while True:
        for q in rng.uniform(arm.lower, arm.upper, (256, arm.n)):
            yield from _visit(make, begin, last, q, model.tip(q), rng)
            begin, last = begin + int(PERIOD_S * 1e9), q


def _visit(
    make: _Messages,
    begin: int,
    start: np.ndarray,
    q: np.ndarray,
    tip: np.ndarray,
    rng: np.random.Generator,
) -> Iterator[Raw]:
    """Messages of one command: joints in motion and at rest, and sightings of the tip."""
    yield make.command(begin, q)
    count = int(PERIOD_S * STATES_HZ)
    share = np.minimum(np.arange(1, count + 1) / (MOVE_S * STATES_HZ), 1.0)[:, None]
    joints = start + share * (q - start) + 1e-5 * rng.standard_normal((count, len(q)))
    seen = tip + 3e-4 * rng.standard_normal((int(PERIOD_S * SIGHTINGS_HZ), 3))
    shown = 0
    for k, row in enumerate(joints):
        stamp = begin + (k + 1) * 10**9 // STATES_HZ - 10**6
        yield make.state(stamp, row)
        if (shown + 1) * STATES_HZ <= (k + 1) * SIGHTINGS_HZ:
            if share[k] == 1.0:
                yield make.sighting(stamp + 10**5, seen[shown])
            shown += 1


class _Messages:
    """Serialised messages of one arm, from patterns whose stamp and numbers are replaced."""

    def __init__(self, arm: Arm) -> None:
        self._types, self._names = message_types(), list(arm.joint_names)
        none, marks = np.array([]), np.full(arm.n, 12345.678)
        self._state, self._q = self._pattern(
            "joint_states", marks, name=self._names, position=marks, velocity=marks, effort=marks
        )
        point = self._make(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=marks,
            velocities=none,
            accelerations=none,
            effort=none,
            time_from_start=self._make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        )
        self._command, self._target = self._pattern(
            "joint_trajectory", marks, joint_names=self._names, points=[point]
        )
        x, y, z = (float(v) for v in marks[:3]) if arm.n > 2 else (12345.678,) * 3
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )
        whole = self._make(
            "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=1e-7 * np.eye(6).ravel()
        )
        self._sighting, self._xyz = self._pattern("tip_measured", np.full(3, x), pose=whole)

    def command(self, stamp: int, q: np.ndarray) -> Raw:
        return self._fill("joint_trajectory", self._command, stamp, self._target, q)

    def state(self, stamp: int, q: np.ndarray) -> Raw:
        return self._fill("joint_states", self._state, stamp, self._q, q)

    def sighting(self, stamp: int, xyz: np.ndarray) -> Raw:
        return self._fill("tip_measured", self._sighting, stamp, self._xyz, xyz)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types.types[kind](**fields)

    def _pattern(self, topic: str, marks: np.ndarray, **fields: Any) -> tuple[bytearray, int]:
        """A serialised message and the offset of the marks in it."""
        stamp = self._make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        header = self._make("std_msgs/msg/Header", stamp=stamp, frame_id="base")
        kind = TYPES[topic]
        data = bytearray(self._types.serialize_cdr(self._make(kind, header=header, **fields), kind))
        return data, data.index(marks.tobytes())

    @staticmethod
    def _fill(topic: str, pattern: bytearray, stamp: int, at: int, values: np.ndarray) -> Raw:
        data = pattern.copy()
        _STAMP.pack_into(data, 4, *divmod(stamp, 10**9))
        data[at : at + 8 * len(values)] = values.tobytes()
        return Raw(topic, stamp, bytes(data))


def write_raw(path: Path, messages: Iterator[Raw], count: int | None = None) -> int:
    """Write messages with the bare library (mcap). Returns their number."""
    connections: dict[str, Any] = {}
    done = 0
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, stamp, data in islice(messages, count):
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    f"/{topic}", TYPES[topic], typestore=message_types()
                )
            writer.write(connections[topic], stamp, data)
            done += 1
    return done
