"""ROS message types for reading and writing bags without ROS."""

from __future__ import annotations

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
