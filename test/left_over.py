"""What killed processes leave in shared memory, which a later graph may wait for."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

SHARED = Path("/dev/shm")
_YOUNG_S = 10.0
"""Age below which a segment may belong to a process that is only starting."""


def remove_segments() -> int:
    """Delete segments of DDS that no living process maps; how many they were.

    Tests kill nodes with SIGKILL, and a port that is left locked is waited for in vain.
    """
    held = set[str]()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):
            held |= {
                line.split()[-1] for line in maps.read_text().splitlines() if "/dev/shm" in line
            }
    gone = 0
    for path in [*SHARED.glob("fastrtps_*"), *SHARED.glob("sem.fastrtps_*")]:
        with contextlib.suppress(OSError):
            if str(path) not in held and time.time() - path.stat().st_mtime > _YOUNG_S:
                path.unlink()
                gone += 1
    return gone
