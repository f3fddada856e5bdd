"""What killed processes leave in shared memory, which a later graph may wait for."""

from __future__ import annotations

import contextlib
import re
import time
from pathlib import Path

SHARED = Path("/dev/shm")
_YOUNG_S = 10.0
"""Age below which a segment may belong to a process that is only starting."""
_NAME = re.compile(r"(?:sem\.)?(fastrtps_[0-9a-z]+)")
"""A segment's name, and what of it its lock and its mutex share."""


def remove_segments() -> int:
    """Delete segments of DDS that no living process maps, with their locks; how many files.

    Tests kill nodes with SIGKILL, and a port that is left locked is waited for in vain.
    """
    held = set[str]()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):
            held |= {name for name in _NAME.findall(maps.read_text())}
    gone = 0
    for path in SHARED.glob("*fastrtps_*"):
        named = _NAME.match(path.name)
        with contextlib.suppress(OSError):
            young = time.time() - path.stat().st_mtime < _YOUNG_S
            if named and named[1] not in held and not young:
                path.unlink()
                gone += 1
    return gone
