"""ROS messages in bags, without ROS: their types, and the time that a message speaks of.

That is its stamp, where that is of the recorder's clock. Receipt is later by what the middleware
and a busy machine take, which differs between topics: only stamps put commands, joints and
sightings in the order in which they happened.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from longarm_comp.share import interface_folders

_NEVER = QosTime(9223372036, 854775807)


def offered(depth: int = 10, *, latched: bool = False) -> Qos:
    """As the graph's publishers offer it: reliable; the last messages for late ones if latched."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_NEVER,
        lifespan=_NEVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_NEVER,
        avoid_ros_namespace_conventions=False,
    )


INTERFACES = "longarm_interfaces"


@lru_cache(maxsize=1)
def message_types() -> Typestore:
    """Jazzy's types and, where its message text is found, those of `longarm_interfaces`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in interface_files():
        name = f"{INTERFACES}/msg/{path.stem}"
        store.register(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    return store


def interface_files() -> list[Path]:
    """The .msg files of `longarm_interfaces`: installed, in an overlay, or in the source tree."""
    for place in interface_folders(INTERFACES, "msg"):
        found = sorted(place.glob("*.msg"))
        if found:
            return found
    return []


CLOCKS_APART = 60.0
"""Seconds between stamp and recording above which the stamp belongs to another clock."""


def moment(stamp_ns: int, received_ns: int) -> int:
    """Time (ns) of a message that was stamped and received then; a stamp of 0 is none."""
    return stamp_ns if abs(stamp_ns - received_ns) < CLOCKS_APART * 1e9 else received_ns


def stamp_of_raw(raw: bytes) -> int:
    """Stamp (ns) of a serialised message that begins with a header."""
    seconds, rest = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * 10**9 + int(rest)


class _Layout(NamedTuple):
    """Bytes before the positions, their format, and which of them are the arm's joints."""

    encoding: bytes
    head: bytes
    begin: int
    numbers: struct.Struct
    order: list[int]


class JointStates:
    """Reads positions of an arm's joints in serialised `sensor_msgs/msg/JointState` messages.

    A robot sends the same names in the same order a hundred times a second: what stands before the
    positions is read again only where it differs from that of the last message of the same length.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._layouts: dict[int, _Layout] = {}

    def __call__(self, raw: bytes) -> tuple[int, tuple[float, ...] | None]:
        """Stamp (ns) and positions (n,) in the arm's order; None where one of its joints lacks."""
        layout = self._layouts.get(len(raw))
        if layout is None or raw[12 : layout.begin] != layout.head or raw[:4] != layout.encoding:
            layout = self._layouts[len(raw)] = self._layout(raw)
        positions = None
        if len(layout.order) == len(self._names):
            values = layout.numbers.unpack_from(raw, layout.begin)
            positions = tuple([values[k] for k in layout.order])
        return stamp_of_raw(raw), positions

    def _layout(self, raw: bytes) -> _Layout:
        """The names, and where the positions begin; the stamp ends before byte 12."""
        at, sign = 12, "<" if raw[1] & 1 else ">"

        def count() -> int:
            nonlocal at
            at += -at % 4
            (found,) = struct.unpack_from(f"{sign}I", raw, at)
            at += 4
            return int(found)

        def text() -> str:
            nonlocal at
            size = count()
            at += size
            return bytes(raw[at - size : at - 1]).decode()

        text()  # frame
        names = [text() for _ in range(count())]
        told = count()
        at += (4 - at) % 8  # the encoding before the message has 4 bytes
        place = {name: k for k, name in enumerate(names[:told])}
        order = [place[name] for name in self._names if name in place]
        return _Layout(raw[:4], raw[12:at], at, struct.Struct(f"{sign}{told}d"), order)
