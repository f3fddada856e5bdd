"""The messages of a bag that make a session, checked and in the order of time."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from longarm_comp.core import quaternion
from longarm_comp.core.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.settled import Sighting, State

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

_CLOCKS_APART = 60.0  # s between stamp and recording above which the stamp is another clock's


class Row(BaseModel):
    """What a `session_row` message tells about a row, as JSON."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    index: int | None = None
    repeat_id: int = -1
    columns: dict[str, float] = {}
    labels: dict[str, str] = {}


@dataclass
class Tape:
    """What was read so far; every time in s from `start_ns`.

    `take` puts a message of a topic in `TYPES` where it belongs, or raises `InputError`.
    """

    arm: Arm
    where: str
    start_ns: int
    commands: list[tuple[float, np.ndarray]] = field(default_factory=list)
    sightings: list[Sighting] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    rows: list[tuple[float, Row]] = field(default_factory=list)
    columns: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    frames: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        """One reader per topic of `TYPES`."""
        self._readers = {name: getattr(self, f"_{name}") for name in TYPES}

    def take(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Read one message of the topic with this last name."""
        self._readers[topic]((stamp_ns - self.start_ns) * 1e-9, message)

    def _joint_trajectory(self, t: float, message: Any) -> None:
        names, known = list(message.joint_names), self.arm.joint_names
        if sorted(names) != sorted(known):
            allowed = f"{', '.join(known)} of arm {self.arm.name}"
            raise self._error("joint_trajectory joint_names", t, ", ".join(names), allowed)
        points = [np.asarray(point.positions, dtype=float) for point in message.points]
        good = all(p.shape == (len(names),) and np.isfinite(p).all() for p in points)
        if not points or not good:
            allowed = f"points of {self.arm.n} finite positions"
            raise self._error("joint_trajectory points", t, "positions", allowed)
        order = [names.index(name) for name in known]
        self.commands.append((t, np.array(points)[:, order]))

    def _joint_states(self, t: float, message: Any) -> None:
        at = dict(zip(message.name, message.position, strict=False))
        if all(name in at for name in self.arm.joint_names):
            self.states.append(State(t, np.array([at[name] for name in self.arm.joint_names])))

    def _tip_measured(self, t: float, message: Any) -> None:
        p = message.pose.pose.position
        xyz = np.array([p.x, p.y, p.z])
        if np.isinf(xyz).any() or np.isnan(xyz).any() != np.isnan(xyz).all():
            raise self._error("tip_measured", t, xyz, "finite, or NaN in x, y and z")
        variance = np.asarray(message.pose.covariance, dtype=float)[[0, 7, 14]]
        stamp = message.header.stamp
        taken = (stamp.sec * 10**9 + stamp.nanosec - self.start_ns) * 1e-9
        taken = taken if abs(taken - t) < _CLOCKS_APART else t
        self.sightings.append(Sighting(taken, xyz, variance))
        self.frames.add(message.header.frame_id)

    def _temperature(self, t: float, message: Any) -> None:
        self._hold("temperature_c", t, message.temperature)

    def _payload(self, t: float, message: Any) -> None:
        self._hold("payload_kg", t, message.data)

    def _inclination(self, t: float, message: Any) -> None:
        """Tilt about x and y of the frame that the message names, from its orientation."""
        o = message.orientation
        frame = re.sub(r"\W+", "_", message.header.frame_id) or "base"
        roll, pitch = quaternion.tilt(np.array([o.x, o.y, o.z, o.w]))
        self._hold(f"incl_{frame}_x", t, roll)
        self._hold(f"incl_{frame}_y", t, pitch)

    def _session_row(self, t: float, message: Any) -> None:
        try:
            self.rows.append((t, Row.model_validate_json(message.data)))
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            allowed = f"{' '.join(map(str, fault['loc']))}: {fault['msg']}"
            raise self._error("session_row", t, message.data, allowed) from error

    def _hold(self, name: str, t: float, value: float) -> None:
        if not math.isfinite(value):
            raise self._error(name, t, value, "a finite number")
        self.columns.setdefault(name, []).append((t, value))

    def _error(self, what: str, t: float, value: object, allowed: str) -> InputError:
        return InputError(self.where, f"{what} at {t:.3f} s", value, allowed)
