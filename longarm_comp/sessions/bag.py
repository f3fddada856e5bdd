"""Reads a session from a rosbag2 folder (mcap or sqlite3); docs/sessions.md has its topics.

A row is a command and the mean of the sightings after the arm has settled, up to the next command.
Topics are found by the last part of their name; others and unknown types are ignored.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sessions.message_buffer import TYPES, MessageBuffer
from longarm_comp.sessions.message_types import JointStates, message_types
from longarm_comp.sessions.rows import Rows


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
        rows = _rows(_recorded(reader, chosen), buffer)
    for topic, found in (("joint_trajectory", buffer.commanded), ("tip_measured", buffer.sighted)):
        if not found:
            raise InputError(where, topic, "no message", "commands and the sightings they led to")
    if len(buffer.frames) > 1:
        raise InputError(where, "tip_measured frame_id", sorted(buffer.frames), "one frame")
    return rows.session()


@contextmanager
def open_bag(path: str | Path) -> Iterator[Reader]:
    """Open a bag for reading."""
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
        recorded = _recorded(reader, _of_one_arm(reader, None, where))
        for name, stamp, message in decoded(recorded, arm, where):
            buffer.take(name, stamp, message)
            while len(buffer.commands) > 1:
                buffer.commands.popleft()
                buffer.forget(buffer.commands[0][0])
    if not buffer.commanded:
        raise InputError(where, "joint_trajectory", "no message", "the command of a move")
    return buffer


def _of_one_arm(reader: Reader, namespace: str | None, where: str) -> list[Connection]:
    """The topics of one arm that are read."""
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
    return list(chosen.values())


def _recorded(reader: Reader, chosen: list[Connection]) -> Iterator[Message]:
    raw = reader.messages(connections=chosen)
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
