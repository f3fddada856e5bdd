"""A session as a rosbag2 of the robot's own topics, for tests of reading.

Per row: a command, the circumstances, one sighting, and a `session_row` with what no topic of the
robot says. A run-up is a via point that the trajectory passes first.
"""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.sessions.csv import write_touches
from longarm_comp.sessions.message_buffer import TYPES
from longarm_comp.sessions.message_types import message_types, publisher_quality

_STORAGE = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
PERIOD_S = 10.0  # between rows of a session that has no times


def write_bag(
    session: Session,
    path: str | Path,
    arm: Arm,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    namespace: str = "",
) -> None:
    """Write a session as a bag folder; `read_bag` gives the same one back."""
    folder = Path(path)
    with Writer(folder, version=9, storage_plugin=_STORAGE[storage]) as writer:
        _Recorder(writer, arm, namespace).write(session)
    write_touches(session.touch_distances, folder)


class _Recorder:
    def __init__(self, writer: Writer, arm: Arm, namespace: str) -> None:
        self._writer = writer
        self._arm = arm
        self._prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        self._types = message_types()
        self._connections: dict[str, Any] = {}

    def write(self, session: Session) -> None:
        times = session.t_s if session.t_s is not None else np.arange(len(session)) * PERIOD_S
        # a clock of 0 would read as "no stamp"
        stamps = 1_000_000_000_000 + np.round((times - times[0]) * 1e9).astype(np.int64)
        steps = np.diff(times)
        shortest = float(steps[steps > 0].min()) if (steps > 0).any() else PERIOD_S
        dwell = int(1e9 * min(2.0, shortest / 4))  # from a command to its sighting
        for i, stamp in enumerate(stamps):
            q, begun = session.q[i], session.run_up[i]
            by = [] if np.isnan(begun).all() else [np.where(np.isnan(begun), q, begun)]
            self._command(int(stamp) - dwell, [*by, q])
            self._circumstances(int(stamp) - dwell // 2, session, i)
            self._sighting(int(stamp), session, i)
            self._row(int(stamp) + dwell // 2, session, i)

    def _put(self, topic: str, stamp: int, **fields: Any) -> None:
        """Write a message; a mapping is a message in it, by the type that its field has."""
        kind = TYPES[topic]
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                self._prefix + topic, kind, typestore=self._types,
                offered_qos_profiles=[publisher_quality()],
            )  # fmt: skip
        data = self._types.serialize_cdr(self._made(kind, fields), kind)
        self._writer.write(self._connections[topic], stamp, data)

    def _made(self, kind: Any, fields: dict[str, Any]) -> Any:
        inner = {name: told[1] for name, told in self._types.get_msgdef(kind).fields}
        made = {k: self._made(inner[k], v) if isinstance(v, dict) else v for k, v in fields.items()}
        return self._types.types[kind](**made)

    def _command(self, stamp: int, path: list[np.ndarray]) -> None:
        empty = np.array([])
        points = [
            self._made(
                "trajectory_msgs/msg/JointTrajectoryPoint",
                {"positions": np.array(positions), "velocities": empty, "accelerations": empty,
                 "effort": empty, "time_from_start": {"sec": k, "nanosec": 0}},
            )
            for k, positions in enumerate(path)
        ]  # fmt: skip
        names = list(self._arm.joint_names)
        self._put(
            "joint_trajectory", stamp, header=_header(stamp), joint_names=names, points=points
        )

    def _circumstances(self, stamp: int, session: Session, i: int) -> None:
        if "temperature_c" in session.columns:
            value = float(session.columns["temperature_c"][i])
            self._put("temperature", stamp, header=_header(stamp), temperature=value, variance=0.0)
        if "payload_kg" in session.columns:
            self._put("payload", stamp, data=float(session.columns["payload_kg"][i]))

    def _sighting(self, stamp: int, session: Session, i: int) -> None:
        xyz = session.xyz[i] if session.has_position[i] else np.full(3, np.nan)
        covariance = np.zeros(36)
        if session.sigma is not None:
            covariance[[0, 7, 14]] = session.sigma[i] ** 2
        turn = np.array([0.0, 0.0, 0.0, 1.0])
        if _stated(session, i):
            turn = session.readings["orientation"][i]
            covariance[[21, 28, 35]] = session.sigmas["orientation"][i] ** 2
        pose = {
            "position": dict(zip("xyz", xyz.tolist(), strict=True)),
            "orientation": dict(zip("xyzw", turn.tolist(), strict=True)),
        }
        with_covariance = {"pose": pose, "covariance": covariance}
        self._put("tip_measured", stamp, header=_header(stamp), pose=with_covariance)

    def _row(self, stamp: int, session: Session, i: int) -> None:
        row = {
            "index": int(session.index[i]),
            "repeat_id": int(session.repeat_id[i]),
            "columns": {
                name: float(values[i])
                for name, values in session.columns.items()
                if not np.isnan(values[i])
            },
            "labels": {name: str(values[i]) for name, values in session.labels.items()},
        }
        for name, field in (("readings", session.readings), ("sigmas", session.sigmas)):
            held = {
                kind: values[i].tolist()
                for kind, values in field.items()
                if not (kind == "orientation" and _stated(session, i))
                and not np.isnan(values[i]).any()
            }
            if name == "readings" and not session.has_position[i] and session.seen[i]:
                held["position"] = [None if np.isnan(v) else float(v) for v in session.xyz[i]]
            row |= {name: held} if held else {}
        if session.told[i].any():
            row["approach"] = session.told[i].tolist()
        self._put("session_row", stamp, data=json.dumps(row))


def _header(stamp: int) -> dict[str, Any]:
    seconds, rest = divmod(stamp, 10**9)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": "base"}


def _stated(session: Session, i: int) -> bool:
    """Whether a row's orientation says how well it is known, so that a sighting can carry it."""
    stated = session.sigmas.get("orientation")
    return bool(session.has_orientation[i] and stated is not None and np.isfinite(stated[i]))
