"""Writer of a bag that is readable at any time while recording: a split rosbag2.

Messages go to a hidden segment.  A finished segment is moved into the bag and entered in
metadata.yaml in one step.  A killed recorder loses only the current segment.  A
recording that fails before its first message leaves no folder.
"""

from __future__ import annotations

import shutil
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer

from longarm_comp.core.errors import InputError, LongarmError
from longarm_comp.core.files import alone_in, write_text
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sessions.message_types import message_types, publisher_quality

_PARTIAL = ".recording"
_KEY = "rosbag2_bagfile_information"


class SegmentedBag:
    """Writer of a bag folder. Use as a context manager; the bag is readable within it.

    Args:
        resume: continue an existing bag.

    Raises:
        InputError: the folder is there and may not be continued; another process writes there.
    """

    def __init__(self, path: str | Path, *, resume: bool = False) -> None:
        self._path = Path(path)
        self._partial = self._path / _PARTIAL
        self._metadata = self._path / "metadata.yaml"
        try:  # a killed recorder may have left a bag without a message
            empty = read_yaml(self._metadata)[_KEY]["message_count"] == 0
        except (LongarmError, KeyError, TypeError):
            empty = False
        self._new = empty or not self._path.exists()
        self._discarded = False
        with ExitStack() as held:
            self._information = self._begin_folder(resume, held)
            self._held = held.pop_all()  # until the end: two recorders remove each other's segments
        self._writer: Writer | None = None
        self._connections: dict[tuple[str, str], Connection] = {}
        self.messages = 0
        """Number of messages in the current segment."""
        self.offers: dict[str, Qos] = {}
        """Quality of service by topic; all other topics have `publisher_quality()`."""

    def _begin_folder(self, resume: bool, held: ExitStack) -> dict[str, Any] | None:
        if not resume and not self._new:
            allowed = "a folder that does not exist yet, or --resume"
            raise InputError(self._path, "bag", "exists", allowed)
        if resume and self._path.exists():
            strangers = [p.name for p in self._path.iterdir() if p.name != _PARTIAL]
            if not self._metadata.is_file() and strangers:
                raise InputError(self._path, "bag", strangers[0], "a bag, to resume it")
        try:
            self._path.mkdir(parents=True, exist_ok=True)
            held.enter_context(alone_in(self._path))
            shutil.rmtree(self._partial, ignore_errors=True)
        except OSError as error:
            said = error.strerror or str(error)
            raise InputError(self._path, "output folder", said, "a folder to write in") from error
        if not self._metadata.is_file():
            return None
        try:
            known = read_yaml(self._metadata)[_KEY]
        except (KeyError, TypeError) as error:
            raise InputError(self._metadata, _KEY, str(error), "metadata of a rosbag2") from error
        if known.get("storage_identifier") != "mcap":
            raise InputError(self._metadata, "storage", known.get("storage_identifier"), "mcap")
        return dict(known)

    def __enter__(self) -> SegmentedBag:
        if self._information is None:
            self._open_segment()  # a bag without a message is valid
            self.finish_segment()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        with self._held:
            self.finish_segment()
            known = self._information
            empty = self._discarded or not (known and known["message_count"])
            if error is not None and self._new and empty:
                for name in (self._metadata.name, *(known or {}).get("relative_file_paths", ())):
                    (self._path / name).unlink(missing_ok=True)
                with suppress(OSError):  # what others put there stays
                    self._path.rmdir()

    def discard(self) -> None:
        """Mark the recording as useless: if an error ends it, its new folder is removed."""
        self._discarded = True

    def write(self, topic: str, kind: str, stamp_ns: int, data: bytes) -> None:
        """Add one serialised message (CDR) of a type that `message_types` knows."""
        writer = self._open_segment()
        connection = self._connections.get((topic, kind))
        if connection is None:
            offers = [self.offers.get(topic, publisher_quality())]
            connection = writer.add_connection(
                topic, kind, typestore=message_types(), offered_qos_profiles=offers
            )
            self._connections[topic, kind] = connection
        writer.write(connection, stamp_ns, data)
        self.messages += 1

    def _open_segment(self) -> Writer:
        if self._writer is None:
            self._writer = Writer(self._segment_path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        return self._writer

    @property
    def _segment_path(self) -> Path:
        known = self._information
        place = len(known["relative_file_paths"]) if known and known["message_count"] else 0
        return self._partial / f"{self._path.name}_{place}"

    def finish_segment(self) -> None:
        """Move everything written so far into the bag."""
        if self._writer is None:
            return
        segment = self._segment_path
        self._writer.close()
        self._writer, self._connections, self.messages = None, {}, 0
        metadata = read_yaml(segment / "metadata.yaml")[_KEY]
        for name in metadata["relative_file_paths"]:
            (segment / name).replace(self._path / name)
        self._information = _merge_metadata(self._information, metadata)
        text = yaml.safe_dump({_KEY: self._information}, sort_keys=False)
        write_text(self._metadata, text)
        shutil.rmtree(self._partial, ignore_errors=True)


def _merge_metadata(one: dict[str, Any] | None, two: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata of two bags as one: files in order, counts added, whole time span."""
    if one is None or not one["message_count"]:
        return two
    first, second = (part["starting_time"]["nanoseconds_since_epoch"] for part in (one, two))
    end = max(first + one["duration"]["nanoseconds"], second + two["duration"]["nanoseconds"])
    start = min(first, second)
    topics: dict[str, dict[str, Any]] = {}
    for entry in (*one["topics_with_message_count"], *two["topics_with_message_count"]):
        name = str(entry["topic_metadata"]["name"])
        known = topics.setdefault(name, {**entry, "message_count": 0})
        known["message_count"] += entry["message_count"]
    return {
        **two,
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": end - start},
        "message_count": one["message_count"] + two["message_count"],
        "topics_with_message_count": list(topics.values()),
        "relative_file_paths": [*one["relative_file_paths"], *two["relative_file_paths"]],
        "files": [*one.get("files", []), *two.get("files", [])],
    }
