"""Types of ROS messages in bags, without ROS, and the time to which a message refers.

That time is the message's stamp, if the stamp is of the recorder's clock.  The time of receipt is
later, by a delay of middleware and machine that differs between topics.  So only the stamps give
the order in which commands, joint states and sightings happened.
"""

import struct
from functools import cache
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


def publisher_quality(depth: int = 10, *, latched: bool = False) -> Qos:
    """Return the quality of service of the graph's publishers, which are reliable.

    If latched, late subscribers get the last `depth` messages.
    """
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


@cache
def message_types() -> Typestore:
    """Return the types of ROS 2 Jazzy, and those of `longarm_interfaces` if its files are found."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in interface_files():
        name = f"{INTERFACES}/msg/{path.stem}"
        store.register(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    return store


def interface_files() -> list[Path]:
    """Find the .msg files of `longarm_interfaces`: installed, in an overlay or the source tree."""
    for place in interface_folders(INTERFACES, "msg"):
        found = sorted(place.glob("*.msg"))
        if found:
            return found
    return []


CLOCKS_APART = 60.0
"""Seconds between stamp and recording above which the stamp belongs to another clock."""


def moment(stamp_ns: int, received_ns: int) -> int:
    """Return the time (ns) to which a message refers: its stamp, else the time of receipt.

    The stamp is not used if it is later than the receipt, as of a clock that is ahead, or earlier
    by `CLOCKS_APART` or more, as a stamp of 0 is.
    """
    return stamp_ns if 0 <= received_ns - stamp_ns < CLOCKS_APART * 1e9 else received_ns


def stamp_of_raw(raw: bytes) -> int:
    """Return the stamp (ns) of a serialised message that begins with a header."""
    seconds, rest = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * 10**9 + int(rest)
