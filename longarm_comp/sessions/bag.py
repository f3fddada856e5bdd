"""Reads a session from a rosbag2 folder (mcap or sqlite3); docs/sessions.md has its topics.

A row is a command and the mean of the sightings after the arm has settled, up to the next command.
Topics are found by the last part of their name; others and unknown types are ignored.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.arm.history import History
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.rest import (
    NO_REST,
    REST_S,
    Sighting,
    in_turn,
    nowhere,
    settled,
    stood,
)
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sessions.message_buffer import TYPES, MessageBuffer, SessionRow, between
from longarm_comp.sessions.message_types import CLOCKS_APART, JointStates, message_types


class _Row(NamedTuple):
    number: int
    q: np.ndarray
    history: History
    sides: np.ndarray
    seen: Sighting
    read: np.ndarray
    told: SessionRow
    held: dict[str, float]


class Rows:
    """What the arm did, command by command, taken off a buffer: each row is made as soon as nothing
    that is read later can change it."""

    def __init__(self, buffer: MessageBuffer) -> None:
        self._buffer = buffer
        self._at: np.ndarray | None = None  # joints of the command before
        self._history = History.unknown(buffer.arm.n)
        self._rows: list[_Row] = []
        self._lost: dict[int, str] = {}
        self._passed = False
        self._told = self._rivals = 0  # commands with readings of joints; with those of two arms
        self._restless: Counter[int] = Counter()  # by joint, commands at whose end it still moved

    def close(self, *, everything: bool = False) -> None:
        """Finish commands whose time is over: a sighting may be recorded `CLOCKS_APART` later."""
        commands = self._buffer.commands
        while len(commands) > 1 and (
            everything or commands[-1][0] >= commands[1][0] + CLOCKS_APART
        ):
            self._finish(commands[1][0])
        if everything and commands:
            self._finish(math.inf)

    def _finish(self, end: float) -> None:
        """The oldest command, which the next one followed at `end` (s)."""
        buffer = self._buffer
        begin, points = buffer.commands.popleft()
        sightings, rows = (between(held, begin, end) for held in (buffer.sightings, buffer.rows))
        states = buffer.states_between(begin, end)
        seen, why = settled(sightings, *states, begin)
        self._told += bool(len(states[0]))
        self._rivals += in_turn(states[1])
        if why == NO_REST:
            late = states[1][states[0] >= states[0][-1] - REST_S]
            self._restless[int(np.argmax(np.ptp(late, axis=0)))] += 1
        row = rows[0][1] if rows else SessionRow()
        passed = seen is None
        if seen is None and rows:  # a measurement was meant: it is a row, and says why it is blank
            seen = nowhere(rows[0][0])
        last = self._rows[-1].number if self._rows else -1
        number = row.index if row.index is not None else last + 1
        gap = not passed and self._rows and not self._passed and not 0 <= number - last <= 1
        if gap:
            self._at, self._history = None, History.unknown(buffer.arm.n)
        told = _sides(row, buffer)
        self._history = self._history.after(points, self._at).with_sides(told)
        self._at = points[-1]
        self._passed = passed
        if seen is not None:
            held = {name: held.at(seen.t) for name, held in buffer.columns.items()}
            read = stood(*states, begin)
            self._rows.append(_Row(number, self._at, self._history, told, seen, read, row, held))
            if why:
                self._lost[number] = why
        buffer.forget(end)

    def session(self) -> Session:
        buffer = self._buffer
        if 2 * self._rivals > self._told:
            value = f"two publishers in turn, after {self._rivals} of {self._told} commands"
            allowed = "one, whose joints do not leap to and fro: end the other and record again"
            raise InputError(buffer.where, "joint_states", value, allowed)
        if not self._rows and self._restless:
            joint, count = self._restless.most_common(1)[0]
            name = buffer.arm.joint_names[joint]
            value = f"{NO_REST}: {name} still moved at the end of {count} of {self._told} commands"
            allowed = "an arm that stands after each command, or longer waits"
            raise InputError(buffer.where, "joint_states", value, allowed)
        if not self._rows:
            allowed = "a sighting per command"
            raise InputError(buffer.where, "tip_measured", "none after a command", allowed)
        rows = self._rows
        variance = np.array([row.seen.variance for row in rows])
        blank = np.array([np.isnan(row.seen.xyz).any() for row in rows])
        columns = {"t_s": np.array([row.seen.t for row in rows])}
        for name, held in buffer.columns.items():
            columns[name] = np.array([row.held.get(name, held.first) for row in rows])
        columns |= _told([row.told.columns for row in rows])
        readings = self._readings()
        return Session(
            index=np.array([row.number for row in rows]),
            q=np.array([row.q for row in rows]),
            xyz=readings.pop("position"),
            approach=np.array([row.history.approach for row in rows]),
            legs=np.array([row.history.legs for row in rows]),
            told=np.array([row.sides for row in rows]),
            repeat_id=np.array([row.told.repeat_id for row in rows]),
            sigma=np.sqrt(np.where(blank[:, None] & (variance <= 0), np.nan, variance))
            if (variance[~blank] > 0).all() and not blank.all()
            else None,
            columns=columns,
            labels=_told([row.told.labels for row in rows]),
            source=buffer.where,
            readings=readings,
            sigmas=self._sigmas(),
            lost=self._lost,
        )

    def _readings(self) -> dict[str, np.ndarray]:
        """What was measured, by kind: what was sighted, and what the rows tell."""
        made = {
            "position": np.array([row.seen.xyz for row in self._rows]),
            "orientation": np.array([row.seen.quaternion for row in self._rows]),
        }
        joints = np.array([row.read for row in self._rows]).T[..., None]
        made |= {f"read_q{k}": values for k, values in enumerate(joints, 1)}
        for name in sorted({name for row in self._rows for name in row.told.readings}):
            if name not in KINDS:
                where = "session_row readings"
                raise InputError(self._buffer.where, where, name, ", ".join(KINDS))
            blank = [math.nan] * len(KINDS[name].cells)
            told = np.array([row.told.readings.get(name, blank) for row in self._rows], dtype=float)
            made[name] = np.where(np.isnan(told), made.get(name, told), told)
        return made

    def _sigmas(self) -> dict[str, np.ndarray]:
        spread = np.array([row.seen.turn_variance for row in self._rows])
        made = {"orientation": np.where(spread > 0, np.sqrt(spread), np.nan)}
        for name in sorted({name for row in self._rows for name in row.told.sigmas}):
            told = np.array([row.told.sigmas.get(name, math.nan) for row in self._rows])
            made[name] = np.where(np.isnan(told), made.get(name, told), told)
        return {name: values for name, values in made.items() if np.isfinite(values).any()}


def _sides(row: SessionRow, buffer: MessageBuffer) -> np.ndarray:
    """(n,) sides of arrival that were recorded without the length of the run-up, else 0."""
    n = buffer.arm.n
    if len(row.approach) not in (0, n):
        raise InputError(buffer.where, "session_row approach", row.approach, f"{n} sides")
    return np.array(row.approach or [0] * n, float)


def _told(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Columns of what every row's `session_row` tells."""
    every = dict.fromkeys(name for row in rows for name in row)
    names = [n for n in every if INCLINATION.match(n) or all(n in row for row in rows)]
    return {name: np.array([row.get(name, math.nan) for row in rows]) for name in names}


def bag_info(path: str | Path) -> dict[str, Any]:
    """Summary of a bag; times in s. A topic's `read`: whether it is used for a session."""
    with open_bag(path) as reader:
        topics = [
            {"topic": c.topic, "type": c.msgtype, "count": c.msgcount,
             "read": TYPES.get(_last(c.topic)) == c.msgtype}
            for c in sorted(reader.connections, key=lambda c: c.topic)
        ]  # fmt: skip
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


def _last(topic: str) -> str:
    return topic.rpartition("/")[2]


Message = tuple[str, str, int, bytes]
"""Topic, type, time of recording (ns), serialised."""


def read_bag(path: str | Path, arm: Arm, namespace: str | None = None) -> Session:
    """Read a session from a bag: its folder or a file; ``namespace``: of one arm of several."""
    where = str(path)
    with open_bag(path) as reader:
        chosen = _of_one_arm(reader, namespace, where)
        has_rows = any(_last(c.topic) == "session_row" and c.msgcount for c in chosen)
        buffer = MessageBuffer(arm, where, reader.start_time, every_command=has_rows)
        rows = _rows(recorded(reader, chosen), buffer)
    if buffer.sent is None or not buffer.frames:
        topic = "joint_trajectory" if buffer.sent is None else "tip_measured"
        raise InputError(where, topic, "no message", "commands and the sightings they led to")
    if len(buffer.frames) > 1:
        raise InputError(where, "tip_measured frame_id", sorted(buffer.frames), "one frame")
    return rows.session()


@contextmanager
def open_bag(path: str | Path) -> Iterator[Reader]:
    where = str(path)
    if Path(path).is_dir() and not (Path(path) / "metadata.yaml").is_file():
        allowed = "a bag folder with metadata.yaml (a recording that was killed has none)"
        raise InputError(where, "metadata.yaml", "missing", allowed)
    if Path(path).is_dir():
        read_yaml(Path(path) / "metadata.yaml")  # the decoder itself has no bounds
    try:
        reader = Reader(Path(path))
        reader.open()
    except Exception as error:  # whatever the decoders of YAML, SQLite and mcap raise
        raise _broken(where, error) from error
    try:
        yield reader
    finally:
        reader.close()


def _broken(where: str, error: Exception) -> InputError:
    said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return InputError(where, "bag", said, "a complete rosbag2 (mcap or sqlite3)")


def read_last(path: str | Path, arm: Arm) -> MessageBuffer:
    """The last command of a bag, and what was recorded after it."""
    where = str(path)
    with open_bag(path) as reader:
        buffer = MessageBuffer(arm, where, reader.start_time, every_command=True)
        messages = recorded(reader, _of_one_arm(reader, None, where))
        for name, stamp, message in decoded(messages, arm, where):
            buffer.take(name, stamp, message)
            while len(buffer.commands) > 1:
                buffer.commands.popleft()
                buffer.forget(buffer.commands[0][0])
    if buffer.sent is None:
        raise InputError(where, "joint_trajectory", "no message", "the command of a move")
    return buffer


def _of_one_arm(reader: Reader, namespace: str | None, where: str) -> list[Connection]:
    """The topics of one arm that are read."""
    known = (c for c in reader.connections if TYPES.get(_last(c.topic)) == c.msgtype)
    chosen = [c for c in known if in_namespace(c.topic, namespace)]
    spaces = sorted({c.topic.rpartition("/")[0] or "/" for c in chosen})
    if len(spaces) > 1:
        raise InputError(where, "namespaces", ", ".join(spaces), "one arm, or say which")
    if not chosen:
        topics = ", ".join(sorted({c.topic for c in reader.connections})) or "no topic"
        raise InputError(where, "topics", topics, ", ".join(TYPES))
    return chosen


def in_namespace(topic: str, namespace: str | None) -> bool:
    """Whether a topic is of this namespace; None: of any."""
    return namespace is None or topic.rpartition("/")[0].strip("/") == namespace.strip("/")


def recorded(reader: Reader, chosen: list[Connection]) -> Iterator[Message]:
    """The messages of these topics; none of an empty list."""
    raw = reader.messages(connections=chosen) if chosen else ()
    return ((c.topic, c.msgtype, stamp, data) for c, stamp, data in raw)


def read_visit(messages: Sequence[Message], arm: Arm) -> Session:
    """The rows of messages of one namespace that are not in a bag yet, as `read_bag` reads them."""
    known = [m for m in messages if TYPES.get(_last(m[0])) == m[1]]
    begin = min((received for _, _, received, _ in known), default=0)
    return _rows(known, MessageBuffer(arm, "recording", begin, every_command=True)).session()


def _rows(messages: Iterable[Message], buffer: MessageBuffer) -> Rows:
    rows = Rows(buffer)
    for name, stamp, message in decoded(messages, buffer.arm, buffer.where):
        buffer.take(name, stamp, message)
        if name == "joint_trajectory":
            rows.close()
    rows.close(everything=True)
    return rows


def decoded(messages: Iterable[Message], arm: Arm, where: str) -> Iterator[tuple[str, int, Any]]:
    """Last part of the topic's name, time of recording (ns), message; in the order of time."""
    types = message_types()
    joint_states = JointStates(arm.joint_names, types)
    try:
        for topic, kind, stamp, raw in messages:
            name = _last(topic)
            states = name == "joint_states"
            yield name, stamp, joint_states(raw) if states else types.deserialize_cdr(raw, kind)
    except Exception as error:  # as in open_bag; what the caller raises does not come here
        raise _broken(where, error) from error
