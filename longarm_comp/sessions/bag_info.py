"""Contents of a bag: topics, types and message counts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from longarm_comp.sessions.bag import open_bag
from longarm_comp.sessions.message_buffer import TYPES


@dataclass(frozen=True)
class TopicInfo:
    """One topic; `read`: whether it is used for a session."""

    topic: str
    type: str
    count: int
    read: bool


@dataclass(frozen=True)
class BagInfo:
    """Summary of a bag; times in s (start since the epoch of its clock)."""

    path: str
    storage: str
    start_s: float
    duration_s: float
    messages: int
    topics: tuple[TopicInfo, ...]


def bag_info(path: str | Path) -> BagInfo:
    """Summarise a bag."""
    with open_bag(path) as reader:
        topics = tuple(
            TopicInfo(c.topic, c.msgtype, c.msgcount, TYPES.get(_last(c.topic)) == c.msgtype)
            for c in sorted(reader.connections, key=lambda c: c.topic)
        )
        folder = Path(path)
        files = folder.iterdir() if folder.is_dir() else [folder]
        storage = "mcap" if any(f.suffix == ".mcap" for f in files) else "sqlite3"
        empty = reader.message_count == 0
        return BagInfo(
            path=str(path),
            storage=storage,
            start_s=0.0 if empty else reader.start_time * 1e-9,
            duration_s=0.0 if empty else reader.duration * 1e-9,
            messages=reader.message_count,
            topics=topics,
        )


def _last(topic: str) -> str:
    return topic.rpartition("/")[2]
