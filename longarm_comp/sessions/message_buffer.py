"""The messages of a bag that are needed for a session, checked and in the order of time.

`forget` drops messages that no further row needs, so that a bag of any length is read in bounded
memory.
"""

import math
from array import array
from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import name_tilt
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.data.rest import Sighting
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.message_types import moment

T = TypeVar("T", bound=tuple[Any, ...])
_time = itemgetter(0)
"""Function that returns the time (s) of a sighting or row, as a key for sorting."""

TYPES = {
    "joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
    "joint_states": "sensor_msgs/msg/JointState",
    "tip_measured": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "temperature": "sensor_msgs/msg/Temperature",
    "payload": "std_msgs/msg/Float64",
    "inclination": "sensor_msgs/msg/Imu",
    "session_row": "std_msgs/msg/String",
}
"""Topics that are read, by last name, and their types."""


class SessionRow(BaseModel):
    """Contents of a `session_row` message about a row, as JSON."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    index: int | None = None
    repeat_id: int = -1
    approach: list[Literal[-1, 0, 1]] = []
    columns: dict[str, float] = {}
    labels: dict[str, str] = {}
    readings: dict[str, list[float | None]] = {}
    sigmas: dict[str, float] = {}


class _Steps:
    """A quantity that keeps its value until the next message; the first is of time `begun_s`."""

    def __init__(self, begun_s: float, first: float) -> None:
        self.begun_s, self.first = begun_s, first
        self._times, self._values = array("d"), array("d")

    def set(self, t: float, value: float) -> None:
        """Set the value from time `t` (s) on."""
        self._times.append(t)
        self._values.append(value)

    def at(self, t: float) -> float:
        """Return the last value up to `t` (s); before the first message, the first value."""
        place = bisect_right(self._times, t)
        return self._values[place - 1] if place else self.first

    def forget(self, until: float) -> None:
        """Drop values that are needed only before `until` (s)."""
        past = bisect_right(self._times, until) - 1
        if past > 0:
            del self._times[:past], self._values[:past]


@dataclass
class MessageBuffer:
    """The messages that may still be needed. All times are in s from `start_ns` (`moment`).

    `take` stores a message of a topic in `TYPES`, or raises `InputError`.
    """

    arm: Arm
    where: str  # name of the bag for error messages
    start_ns: int
    every_command: bool
    """Whether a command that repeats the last one counts. If False, it is ignored, unless it has
    several points."""
    commands: deque[tuple[float, np.ndarray]] = field(default_factory=deque)
    """Time and points (k, n), oldest first."""
    sightings: list[Sighting] = field(default_factory=list)  # by the time they were taken
    rows: list[tuple[float, SessionRow]] = field(default_factory=list)
    """Contents of `session_row` messages, by time."""
    columns: dict[str, _Steps] = field(default_factory=dict)  # temperature, payload, inclinations
    frames: set[str] = field(default_factory=set)  # of the sightings
    sent: np.ndarray | None = None  # (n,) end of the last command that counted

    def __post_init__(self) -> None:
        self._times, self._joints = array("d"), array("d")
        self._received_ns = self.start_ns

    def take(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Store one message.

        Args:
            topic: last part of the topic's name.
            stamp_ns: time of recording.
        """
        self._received_ns = stamp_ns
        t = (stamp_ns - self.start_ns) * 1e-9
        if topic == "temperature":
            self._set_column("temperature_c", t, message.temperature)
        elif topic == "payload":
            self._set_column("payload_kg", t, message.data)
        else:
            getattr(self, f"_take_{topic}")(t, message)

    def _message_time(self, stamp_ns: int) -> float:
        """Return the time (s) of the message being stored, from its own stamp."""
        return (moment(stamp_ns, self._received_ns) - self.start_ns) * 1e-9

    def states_between(self, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Return times (m,) and measured joints (m, n) after `begin` and before `end` (s)."""
        low, high = bisect_right(self._times, begin), bisect_left(self._times, end)
        n = self.arm.n
        joints = np.array(self._joints[low * n : high * n]).reshape(-1, n)
        return np.array(self._times[low:high]), joints

    def forget(self, until: float) -> None:
        """Drop messages that are needed only before `until` (s)."""
        for records in (self.sightings, self.rows):
            del records[: bisect_right(records, until, key=_time)]  # type: ignore[call-overload]
        past = bisect_right(self._times, until)
        del self._times[:past], self._joints[: past * self.arm.n]
        for steps in self.columns.values():
            steps.forget(until)

    def _take_joint_trajectory(self, t: float, message: Any) -> None:
        names, known = list(message.joint_names), self.arm.joint_names
        if sorted(names) != sorted(known):
            allowed = f"{', '.join(known)} of arm {self.arm.name}"
            raise self._error_at("joint_trajectory joint_names", t, ", ".join(names), allowed)
        points = [np.asarray(point.positions, dtype=float) for point in message.points]
        good = all(p.shape == (len(names),) and np.isfinite(p).all() for p in points)
        if not points or not good:
            allowed = f"points of {self.arm.n} finite positions"
            raise self._error_at("joint_trajectory points", t, "positions", allowed)
        order = [names.index(name) for name in known]
        q = np.array(points)[:, order]
        if (
            self.every_command
            or self.sent is None
            or len(q) > 1
            or np.abs(q[0] - self.sent).max() >= SAME_POSE
        ):
            sent = min(t, self._message_time(_stamp_ns(message)))  # not one to come
            self.commands.append((sent, q))
            self.sent = q[-1]

    def _take_joint_states(self, t: float, message: Any) -> None:
        """Store positions in the arm's order.

        A message without one of the joints, and one before the first command, is ignored.
        """
        at = dict(zip(message.name, message.position.tolist(), strict=False))
        if self.commands and all(name in at for name in self.arm.joint_names):
            time_s = self._message_time(_stamp_ns(message))
            place = bisect_right(self._times, time_s)  # nearly always the end
            self._times.insert(place, time_s)
            n = self.arm.n
            self._joints[place * n : place * n] = array("d", [at[k] for k in self.arm.joint_names])

    def _take_tip_measured(self, t: float, message: Any) -> None:
        p = message.pose.pose.position
        xyz = np.array([p.x, p.y, p.z])
        if np.isinf(xyz).any() or np.isnan(xyz).any() != np.isnan(xyz).all():
            raise self._error_at("tip_measured", t, xyz, "finite, or NaN in x, y and z")
        covariance = np.asarray(message.pose.covariance, dtype=float)
        turn, turn_variance = np.full(4, np.nan), 0.0
        spread = covariance[[21, 28, 35]]
        if np.isfinite(spread).all() and (spread > 0).all():  # it says how well it is known
            o = message.pose.pose.orientation
            turn, turn_variance = np.array([o.x, o.y, o.z, o.w]), float(spread.mean())
            if not quaternion.is_unit(turn):
                raise self._error_at(
                    "tip_measured orientation", t, turn, "a quaternion of length 1"
                )
        variance = covariance[[0, 7, 14]]
        if not (np.isfinite(variance) & (variance > 0)).all():  # it does not say
            variance = np.full(3, np.nan)
        at = self._message_time(_stamp_ns(message))
        sighting = Sighting(at, xyz, variance, turn, turn_variance)
        insort(self.sightings, sighting, key=_time)
        self.frames.add(message.header.frame_id)

    _take_tip_seen = _take_tip_measured

    def _take_inclination(self, t: float, message: Any) -> None:
        """Store the tilt about x and y of the frame in the header, from its orientation."""
        if message.orientation_covariance[0] < 0:  # it measures none
            return
        o = message.orientation
        turn = np.array([o.x, o.y, o.z, o.w])
        if not quaternion.is_unit(turn):
            raise self._error_at("inclination orientation", t, turn, "a quaternion of length 1")
        tilt = name_tilt(message.header.frame_id, *quaternion.compute_tilt(turn))
        for name, value in tilt.items():
            self._set_column(name, t, value)

    def _take_session_row(self, t: float, message: Any) -> None:
        try:
            insort(self.rows, (t, SessionRow.model_validate_json(message.data)), key=_time)
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            allowed = f"{' '.join(map(str, fault['loc']))}: {fault['msg']}"
            raise self._error_at("session_row", t, message.data, allowed) from error

    def _set_column(self, name: str, t: float, value: float) -> None:
        if not math.isfinite(value):
            raise self._error_at(name, t, value, "a finite number")
        self.columns.setdefault(name, _Steps(t, value)).set(t, value)

    def _error_at(self, what: str, t: float, value: object, allowed: str) -> InputError:
        return InputError(self.where, f"{what} at {t:.3f} s", value, allowed)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def between(records: list[T], begin: float, end: float) -> list[T]:
    """Return the sightings or rows of a buffer after `begin` and before `end` (s)."""
    low, high = bisect_right(records, begin, key=_time), bisect_left(records, end, key=_time)
    return records[low:high]
