"""ROS message types for reading and writing bags without ROS."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from longarm_comp.share import interface_folders

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
