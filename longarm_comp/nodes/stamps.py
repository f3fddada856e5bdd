"""Stamps of messages as whole nanoseconds."""

from __future__ import annotations

import time

from builtin_interfaces.msg import Time


def stamp_ns(stamp: Time) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def sent_s(source_ns: int) -> float:
    """Monotonic seconds at which a message was sent, from the middleware's time of sending."""
    return time.monotonic() - max(0.0, 1e-9 * (time.time_ns() - source_ns) if source_ns else 0.0)


def stamp_of(ns: int) -> Time:
    return Time(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)
