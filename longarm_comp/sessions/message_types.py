"""ROS messages in bags, without ROS: their types, and the time that a message speaks of.

That is its stamp, where that is of the recorder's clock. Receipt is later by what the middleware
and a busy machine take, which differs between topics: only stamps put commands, joints and
sightings in the order in which they happened.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from pathlib import Path

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
