"""Reads a session from a rosbag2 folder (mcap or sqlite3); docs/sessions.md has its topics.

A row is a command and the mean of the sightings after the arm has settled, up to the next command.
Topics are recognised by the last part of their name and their type; all others are ignored.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.measuring import KnownDistance
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.rest import (
    NO_REST,
    REST_S,
    Sighting,
    blank_sighting,
    is_of_two_arms,
    joints_at_rest,
    mean_at_rest,
)
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sessions.message_buffer import TYPES, MessageBuffer, SessionRow, between
from longarm_comp.sessions.message_types import CLOCKS_APART, message_types

NO_LOAD = "nobody had told the payload yet"
"""The reason why a row before the first message about the payload is blank."""


class _Row(NamedTuple):
    number: int
    q: np.ndarray
    history: History
    sides: np.ndarray
    """(n,) sides of arrival that were recorded without the length of the run-up, else 0."""
    sighting: Sighting
    read: np.ndarray
    given: SessionRow
    columns: dict[str, float]


class Rows:
    """The rows of a recording, made command by command from a message buffer.

    Each row is made as soon as no later message can change it.
    """

    def __init__(self, buffer: MessageBuffer) -> None:
        self._buffer = buffer
        self._at: np.ndarray | None = None  # joints of the command before
        self._history = History.unknown(buffer.arm.n)
        self._rows: list[_Row] = []
        self._lost: dict[int, str] = {}
        self._passed = False
        self._with_joints = self._rivals = 0  # commands with readings of joints; of two arms
        self._restless: Counter[int] = Counter()  # by joint, commands at whose end it still moved

    def close(self, *, everything: bool = False) -> None:
        """Make those rows that no later message can change.

        A sighting may be recorded up to `CLOCKS_APART` s after it was taken.

        Args:
            everything: the recording has ended, so make the rows of all commands.
        """
        commands = self._buffer.commands
        while len(commands) > 1 and (
            everything or commands[-1][0] >= commands[1][0] + CLOCKS_APART
        ):
            self._finish_command(commands[1][0])
        if everything and commands:
            self._finish_command(math.inf)
        if everything:
            self._blank_unknown_loads()

    def _blank_unknown_loads(self) -> None:
        told = self._buffer.columns.get("payload_kg")
        begun_s = -math.inf if told is None else told.begun_s
        for k, row in enumerate(self._rows):
            if row.sighting.t < begun_s and "payload_kg" not in row.given.columns:
                given = row.given.model_copy(update={"readings": {}})
                self._rows[k] = row._replace(sighting=blank_sighting(row.sighting.t), given=given)
                self._lost.setdefault(row.number, NO_LOAD)

    def _finish_command(self, end: float) -> None:
        """Make the row of the oldest command; the next command came at `end` (s)."""
        buffer, n = self._buffer, self._buffer.arm.n
        begin, points = buffer.commands.popleft()
        sightings, rows = (between(each, begin, end) for each in (buffer.sightings, buffer.rows))
        times, joints = buffer.states_between(begin, end)
        sighting, why = mean_at_rest(sightings, times, joints, begin)
        self._with_joints += bool(len(times))
        self._rivals += is_of_two_arms(joints)
        if why == NO_REST:
            late = joints[times >= times[-1] - REST_S]
            self._restless[int(np.argmax(np.ptp(late, axis=0)))] += 1
        given = rows[0][1] if rows else SessionRow()
        for t, other in rows:
            if other != given:
                where = f"session_row at {t:.3f} s"
                raise InputError(buffer.where, where, "another of one command", "one a command")
        passed = sighting is None
        if sighting is None and rows:  # it was to be measured: a row says why it is blank
            sighting = blank_sighting(rows[0][0])
        last = self._rows[-1].number if self._rows else -1
        number = given.index if given.index is not None else last + 1
        if not passed and self._rows and not self._passed and not 0 <= number - last <= 1:
            self._at, self._history = None, History.unknown(n)
        if len(given.approach) not in (0, n):
            raise InputError(buffer.where, "session_row approach", given.approach, f"{n} sides")
        sides = np.array(given.approach or [0] * n, float)
        self._history = self._history.after(points, self._at).with_sides(sides)
        self._at = points[-1]
        self._passed = passed
        if sighting is not None:
            columns = {name: values.at(sighting.t) for name, values in buffer.columns.items()}
            read = joints_at_rest(times, joints, begin)
            self._rows.append(
                _Row(number, self._at, self._history, sides, sighting, read, given, columns)
            )
            if why:
                self._lost[number] = why
        buffer.forget(end)

    def session(self, touch_distances: tuple[KnownDistance, ...] = ()) -> Session:
        """Return the rows as a session.

        Raises:
            InputError: there are no rows, two arms publish `joint_states` in turn, or a
                `session_row` holds an unknown kind of reading, or lacks a number that others hold.
        """
        buffer, rows = self._buffer, self._rows
        if 2 * self._rivals > self._with_joints:
            value = f"two publishers in turn, after {self._rivals} of {self._with_joints} commands"
            allowed = "one, whose joints do not leap to and fro: end the other and record again"
            raise InputError(buffer.where, "joint_states", value, allowed)
        if not rows and self._restless:
            joint, count = self._restless.most_common(1)[0]
            moved = f"{buffer.arm.joint_names[joint]} still moved at the end of {count} of"
            value = f"{NO_REST}: {moved} {self._with_joints} commands"
            allowed = "an arm that stands after each command, or longer waits"
            raise InputError(buffer.where, "joint_states", value, allowed)
        if not rows:
            allowed = "a sighting per command"
            raise InputError(buffer.where, "tip_measured", "none after a command", allowed)
        variance = np.array([row.sighting.variance for row in rows])
        blank = np.array([np.isnan(row.sighting.xyz).any() for row in rows])
        sigma = np.sqrt(variance) if np.isfinite(variance[~blank]).any() else None
        columns = {"t_s": np.array([row.sighting.t for row in rows])}
        for name, values in buffer.columns.items():
            columns[name] = np.array([row.columns.get(name, values.first) for row in rows])
        readings = {"orientation": np.array([row.sighting.quaternion for row in rows])}
        joints = np.array([row.read for row in rows]).T[..., None]
        readings |= {f"read_q{k}": values for k, values in enumerate(joints, 1)}
        readings["position"] = np.array([row.sighting.xyz for row in rows])
        for name in sorted({name for row in rows for name in row.given.readings}):
            if name not in KINDS:
                raise InputError(buffer.where, "session_row readings", name, ", ".join(KINDS))
            none = [math.nan] * len(KINDS[name].cells)
            given = np.array([row.given.readings.get(name, none) for row in rows], dtype=float)
            readings[name] = np.where(np.isnan(given), readings.get(name, given), given)
        spread = np.array([row.sighting.turn_variance for row in rows])
        sigmas = {"orientation": np.where(spread > 0, np.sqrt(spread), np.nan)}
        for name in sorted({name for row in rows for name in row.given.sigmas}):
            given = np.array([row.given.sigmas.get(name, math.nan) for row in rows])
            sigmas[name] = np.where(np.isnan(given), sigmas.get(name, given), given)
        return Session(
            index=np.array([row.number for row in rows]),
            q=np.array([row.q for row in rows]),
            xyz=readings.pop("position"),
            approach=np.array([row.history.approach for row in rows]),
            legs=np.array([row.history.legs for row in rows]),
            last_way=np.array([row.history.last_way for row in rows]),
            told=np.array([row.sides for row in rows]),
            repeat_id=np.array([row.given.repeat_id for row in rows]),
            sigma=sigma,
            columns=columns | _columns_of(rows, buffer.where),
            labels={
                name: np.array([row.given.labels.get(name, "") for row in rows])
                for name in dict.fromkeys(name for row in rows for name in row.given.labels)
            },
            source=buffer.where,
            readings=readings,
            sigmas={name: values for name, values in sigmas.items() if np.isfinite(values).any()},
            touch_distances=touch_distances,
            lost=self._lost,
        )


def _columns_of(rows: Sequence[_Row], where: str) -> dict[str, np.ndarray]:
    """Return the numbers (N,) by name that rows were given; inclinations may be missing (NaN)."""
    columns = {}
    for name in dict.fromkeys(name for row in rows for name in row.given.columns):
        lacking = [row.number for row in rows if name not in row.given.columns]
        if lacking and not INCLINATION.match(name):
            what = f"session_row columns {name}"
            raise InputError(where, what, f"none at index {lacking[0]}", "a number in every row")
        columns[name] = np.array([row.given.columns.get(name, math.nan) for row in rows])
    return columns


def bag_info(path: str | Path) -> dict[str, Any]:
    """Return a summary of a bag: storage, start and duration in s, number of messages, topics.

    `read` of a topic tells whether a session is made from it.
    """
    with open_bag(path) as reader:
        topics = [
            {
                "topic": c.topic,
                "type": c.msgtype,
                "count": c.msgcount,
                "read": TYPES.get(last_part(c.topic)) == c.msgtype,
            }
            for c in sorted(reader.connections, key=lambda c: c.topic)
        ]
        folder = Path(path)
        files = folder.iterdir() if folder.is_dir() else [folder]
        empty = reader.message_count == 0
        return {
            "path": str(path),
            "storage": "mcap" if any(f.suffix == ".mcap" for f in files) else "sqlite3",
            "start_s": 0.0 if empty else reader.start_time * 1e-9,
            "duration_s": 0.0 if empty else reader.duration * 1e-9,
            "messages": reader.message_count,
            "topics": topics,
        }


def last_part(topic: str) -> str:
    """Return the last part of a topic's name, which is the same in every namespace."""
    return topic.rpartition("/")[2]


Message = tuple[str, str, int, bytes]
"""A recorded message: topic, type, time of recording (ns), serialised content."""


def read_bag(
    path: str | Path,
    arm: Arm,
    namespace: str | None = None,
    touch_distances: tuple[KnownDistance, ...] = (),
) -> Session:
    """Read a session from a bag: its folder or a file.

    Args:
        namespace: namespace of the arm, if the bag holds several arms.
        touch_distances: known distances between the points that the session touches.

    Raises:
        InputError: the bag is damaged, holds no command or no sighting, or several arms or frames.
    """
    rows, _ = _read_rows(path, arm, namespace)
    return rows.session(touch_distances)


def read_seen(path: str | Path, arm: Arm, namespace: str | None = None) -> tuple[Session, str]:
    """Read a session as `read_bag` does, but with the tip as `kinematics` placed it (`tip_seen`).

    Returns:
        The session, and the frame of its tips: that of the base, if the place of the tracker was
        known.
    """
    rows, frame = _read_rows(path, arm, namespace, "tip_seen")
    return rows.session(), frame


def _read_rows(
    path: str | Path, arm: Arm, namespace: str | None, tips: str = "tip_measured"
) -> tuple[Rows, str]:
    """Return the rows of a bag and the frame of its sightings; ``tips`` is their topic."""
    where = str(path)
    with open_bag(path) as reader:
        chosen = _topics_of_one_arm(reader, namespace, where, tips)
        has_rows = any(last_part(c.topic) == "session_row" and c.msgcount for c in chosen)
        buffer = MessageBuffer(arm, where, reader.start_time, every_command=has_rows)
        rows = _rows(raw_messages(reader, chosen), buffer)
    if buffer.sent is None or not buffer.frames:
        topic = "joint_trajectory" if buffer.sent is None else tips
        raise InputError(where, topic, "no message", "commands and the sightings they led to")
    if len(buffer.frames) > 1:
        raise InputError(where, f"{tips} frame_id", sorted(buffer.frames), "one frame")
    return rows, next(iter(buffer.frames))


@contextmanager
def open_bag(path: str | Path) -> Iterator[Reader]:
    """Open a bag for reading. Raises InputError if it is incomplete or damaged."""
    where, metadata = str(path), Path(path) / "metadata.yaml"
    if Path(path).is_dir():
        if not metadata.is_file():
            allowed = "a bag folder with metadata.yaml (a recording that was killed has none)"
            raise InputError(where, "metadata.yaml", "missing", allowed)
        read_yaml(metadata)  # the decoder itself has no bounds
    try:
        reader = Reader(Path(path))
        reader.open()
    except Exception as error:  # whatever the decoders of YAML, SQLite and mcap raise
        raise _make_broken(where, error) from error
    try:
        yield reader
    finally:
        reader.close()


def _make_broken(where: str, error: Exception) -> InputError:
    said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return InputError(where, "bag", said, "a complete rosbag2 (mcap or sqlite3)")


def read_last(path: str | Path, arm: Arm) -> MessageBuffer:
    """Return a buffer that holds the last command of a bag and the messages after it.

    Raises InputError if the bag is damaged or holds no command.
    """
    where = str(path)
    with open_bag(path) as reader:
        buffer = MessageBuffer(arm, where, reader.start_time, every_command=True)
        messages = raw_messages(reader, _topics_of_one_arm(reader, None, where))
        for name, stamp, message in decode(messages, where):
            buffer.take(name, stamp, message)
            while len(buffer.commands) > 1:
                buffer.commands.popleft()
                buffer.forget(buffer.commands[0][0])
    if buffer.sent is None:
        raise InputError(where, "joint_trajectory", "no message", "the command of a move")
    return buffer


def _topics_of_one_arm(
    reader: Reader, namespace: str | None, where: str, tips: str = "tip_measured"
) -> list[Connection]:
    """Return the connections of the topics from which one arm's session is read.

    A bag without known topics, or with known topics in several namespaces, is refused.
    """
    types = {tips if name == "tip_measured" else name: kind for name, kind in TYPES.items()}
    known = (c for c in reader.connections if types.get(last_part(c.topic)) == c.msgtype)
    chosen = [c for c in known if in_namespace(c.topic, namespace)]
    spaces = sorted({c.topic.rpartition("/")[0] or "/" for c in chosen})
    if len(spaces) > 1:
        raise InputError(where, "namespaces", ", ".join(spaces), "one arm, or say which")
    if not chosen:
        topics = ", ".join(sorted({c.topic for c in reader.connections})) or "no topic"
        raise InputError(where, "topics", topics, ", ".join(types))
    return chosen


def in_namespace(topic: str, namespace: str | None) -> bool:
    """Tell whether a topic is in this namespace; True for every topic if `namespace` is None."""
    return namespace is None or topic.rpartition("/")[0].strip("/") == namespace.strip("/")


def raw_messages(reader: Reader, chosen: list[Connection]) -> Iterator[Message]:
    """Iterate over the messages of the chosen topics; there are none if `chosen` is empty."""
    raw = reader.messages(connections=chosen) if chosen else ()
    return ((c.topic, c.msgtype, stamp, data) for c, stamp, data in raw)


def read_visit(messages: Sequence[Message], arm: Arm) -> Session:
    """Return a session from messages of one namespace that are not in a bag yet."""
    known = [m for m in messages if TYPES.get(last_part(m[0])) == m[1]]
    begin = min((received for _, _, received, _ in known), default=0)
    return _rows(known, MessageBuffer(arm, "recording", begin, every_command=True)).session()


def _rows(messages: Iterable[Message], buffer: MessageBuffer) -> Rows:
    rows = Rows(buffer)
    for name, stamp, message in decode(messages, buffer.where):
        buffer.take(name, stamp, message)
        if name == "joint_trajectory":
            rows.close()
    rows.close(everything=True)
    return rows


def decode(messages: Iterable[Message], where: str) -> Iterator[tuple[str, int, Any]]:
    """Yield the last part of the topic's name, the time of recording (ns) and the message."""
    types = message_types()
    try:
        for topic, kind, stamp, raw in messages:
            yield last_part(topic), stamp, types.deserialize_cdr(raw, kind)
    except Exception as error:  # as in open_bag; what the caller raises does not come here
        raise _make_broken(where, error) from error
