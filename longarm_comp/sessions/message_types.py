"""ROS message types for reading and writing bags without ROS."""

from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

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
    places = [Path(sys.prefix) / "share", Path(__file__).resolve().parents[2]]
    for entry in map(Path, sys.path):
        if entry.name in ("site-packages", "dist-packages") and len(entry.parents) > 2:
            places.insert(0, entry.parents[2] / "share")  # prefix/lib/pythonX.Y/site-packages
    for place in places:
        found = sorted((place / INTERFACES / "msg").glob("*.msg"))
        if found:
            return found
    return []
