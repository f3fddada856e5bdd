"""A rosbag2 folder (mcap or sqlite3) as a session.

A row is a command and what was seen once the arm had settled at it: the mean of the settled
sightings up to the next command.  A command without any sighting only passes through, and so
does one at which the measured joints did not rest: like the via points of a trajectory it
tells from which side the joints arrived.  A sighting at NaN is a lost marker.  Temperature and
payload hold until the next message; `session_row` messages, where recorded, add index,
repeats, labels and further columns.

Topics are found by their last name, so any namespace will do; other topics and unknown types
are passed over.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from longarm_comp.core.arm import Arm
from longarm_comp.core.dataset import SAME_POSE, Session, derive_approach
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.message_types import message_types
from longarm_comp.sessions.settled import Sighting, settled
from longarm_comp.sessions.tape import TYPES, Row, Tape


def read_bag(path: str | Path, arm: Arm, namespace: str | None = None) -> Session:
    """Read a session from a bag.

    Args:
        path: the bag's folder, or one of its files.
        arm: names and orders the joints.
        namespace: which arm, when the bag holds several.

    Raises:
        InputError: no bag, cut short, without commands or sightings, joints of another arm.
    """
    where = str(path)
    with open_bag(path) as reader:
        tape = _wind(reader, arm, namespace, where)
    for topic, found in (("joint_trajectory", tape.commands), ("tip_measured", tape.sightings)):
        if not found:
            raise InputError(where, topic, "no message", "commands and the sightings they led to")
    if len(tape.frames) > 1:
        raise InputError(where, "tip_measured frame_id", sorted(tape.frames), "one frame")
    return _session(tape)


@contextmanager
def open_bag(path: str | Path) -> Iterator[Reader]:
    """A bag, open for reading.

    Raises:
        InputError: there is none, or it is cut short.
    """
    where = str(path)
    if Path(path).is_dir() and not (Path(path) / "metadata.yaml").is_file():
        allowed = "a bag folder with metadata.yaml (a recording that was killed has none)"
        raise InputError(where, "metadata.yaml", "missing", allowed)
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


def _wind(reader: Reader, arm: Arm, namespace: str | None, where: str) -> Tape:
    chosen = {}
    for connection in reader.connections:
        space, _, name = connection.topic.rpartition("/")
        wanted = namespace is None or space.strip("/") == namespace.strip("/")
        if wanted and TYPES.get(name) == connection.msgtype:
            chosen[connection.id] = connection
    spaces = sorted({c.topic.rpartition("/")[0] or "/" for c in chosen.values()})
    if len(spaces) > 1:
        raise InputError(where, "namespaces", ", ".join(spaces), "one arm, or say which")
    if not chosen:
        topics = ", ".join(sorted({c.topic for c in reader.connections})) or "no topic"
        raise InputError(where, "topics", topics, ", ".join(TYPES))
    tape = Tape(arm, where, reader.start_time)
    for name, stamp, message in _messages(reader, list(chosen.values()), where):
        tape.take(name, stamp, message)
    return tape


def _messages(
    reader: Reader, connections: list[Connection], where: str
) -> Iterator[tuple[str, int, Any]]:
    """Topic's last name, time of recording (ns) and message, in the order of time."""
    types = message_types()
    try:
        for connection, stamp, raw in reader.messages(connections=connections):
            name = connection.topic.rpartition("/")[2]
            yield name, stamp, types.deserialize_cdr(raw, TYPES[name])
    except Exception as error:  # as in open_bag; what the caller raises does not come here
        raise _broken(where, error) from error


class _Track:
    """Records that begin with their time (s): those within a span, quickly."""

    def __init__(self, records: Sequence[Any]) -> None:
        self._records = sorted(records, key=lambda record: record[0])
        self._times = [record[0] for record in self._records]

    def __call__(self, begin: float, end: float) -> list[Any]:
        return self._records[bisect_right(self._times, begin) : bisect_left(self._times, end)]


def _session(tape: Tape) -> Session:
    commands = tape.commands if tape.rows else _without_copies(tape.commands)
    ends = [t for t, _ in commands[1:]] + [math.inf]
    between = (_Track(tape.sightings), _Track(tape.states), _Track(tape.rows))
    path: list[np.ndarray] = []  # every point passed, rows and vias
    count: list[int] = []  # its place; a step of two is a gap
    at_row: list[int] = []
    made: list[Sighting] = []
    told: list[Row] = []
    index: list[int] = []
    place, passed = 0, False
    for (begin, points), end in zip(commands, ends, strict=True):
        sightings, states, rows = (track(begin, end) for track in between)
        seen = settled(sightings, states, begin)
        row = rows[0][1] if rows else Row()
        number = row.index if row.index is not None else index[-1] + 1 if index else 0
        gap = seen and index and not passed and not 0 <= number - index[-1] <= 1
        for k, q in enumerate(points):
            place += 2 if gap and k == 0 else 1
            path.append(q)
            count.append(place)
        passed = seen is None
        if seen is not None:
            at_row.append(len(path) - 1)
            made.append(seen)
            told.append(row)
            index.append(number)
    if not made:
        raise InputError(
            tape.where, "tip_measured", "none after a command", "a sighting per command"
        )
    q = np.array(path)
    xyz = np.array([seen.xyz for seen in made])
    variance = np.array([seen.variance for seen in made])
    times = np.array([seen.t for seen in made])
    columns = {"t_s": times}
    for name, held in tape.columns.items():
        moments, values = np.array(held).T
        columns[name] = values[np.maximum(np.searchsorted(moments, times, "right") - 1, 0)]
    columns |= _told([row.columns for row in told])
    return Session(
        index=np.array(index),
        q=q[at_row],
        xyz=xyz,
        approach=derive_approach(q, np.array(count))[at_row],
        repeat_id=np.array([row.repeat_id for row in told]),
        sigma=np.sqrt(variance) if (variance > 0).all() else None,
        columns=columns,
        labels=_told([row.labels for row in told]),
        source=tape.where,
    )


def _without_copies(commands: list[tuple[float, np.ndarray]]) -> list[tuple[float, np.ndarray]]:
    """A command that is sent again while the arm is there or on its way is one command."""
    made = commands[:1]
    for t, points in commands[1:]:
        if len(points) > 1 or np.abs(points[0] - made[-1][1][-1]).max() >= SAME_POSE:
            made.append((t, points))
    return made


def _told(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Columns of what every row's `session_row` tells."""
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return {name: np.array([row[name] for row in rows]) for name in names}
