"""The time a message speaks of: its stamp, where that is of the recorder's clock.

Receipt is later by what the middleware and a busy machine take, which differs between topics. Only
stamps put commands, joints and sightings in the order in which they happened.
"""

from __future__ import annotations

import struct

CLOCKS_APART = 60.0
"""Seconds between stamp and recording above which the stamp belongs to another clock."""


def moment(stamp_ns: int, received_ns: int) -> int:
    """Time (ns) of a message that was stamped and received then; a stamp of 0 is none."""
    return stamp_ns if abs(stamp_ns - received_ns) < CLOCKS_APART * 1e9 else received_ns


def stamp_of_raw(raw: bytes) -> int:
    """Stamp (ns) of a serialised message that begins with a header."""
    seconds, rest = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * 10**9 + int(rest)
