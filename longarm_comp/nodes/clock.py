"""Stamps of messages as whole nanoseconds, and timers of a steady clock."""

import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future


def stamp_ns(stamp: Time) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def told_ns(stamp: Time, now_ns: int) -> int:
    """Return the time (ns) of a message's content: its stamp, or now if this is 0 or later."""
    return min(stamp_ns(stamp) or now_ns, now_ns)


_SLEEPLESS = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


def sleepless_s() -> float:
    """Return monotonic seconds that include the time for which the machine was suspended."""
    return time.clock_gettime(_SLEEPLESS)


def told_age_s(sent_ns: int, now_ns: int) -> float | None:
    """Return how long ago (s) something was sent by its sender's clock; None if that is not told.

    A time in the future tells nothing: that clock is ahead, nobody knows how far.
    """
    return 1e-9 * (now_ns - sent_ns) if 0 < sent_ns <= now_ns else None


def sent_s(source_ns: int) -> float | None:
    """Return when (sleepless s) a message was sent, if its sender's wall clock tells it."""
    age_s = told_age_s(source_ns, time.time_ns())
    return None if age_s is None else sleepless_s() - age_s


def stamp_of(ns: int) -> Time:
    return Time(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)


def steady_timer(node: Node, period_s: float, callback: Callable[[], Any]) -> Any:
    """Make a timer that calls back every ``period_s`` (s) of a steady clock."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class Ticks:
    """The ticks of a steady timer (period in s), which is off while no coroutine awaits a tick."""

    def __init__(self, node: Node, period_s: float) -> None:
        self._node = node
        self._awaited: list[Future] = []
        self._timer = steady_timer(node, period_s, self._wake_awaited)
        self._timer.cancel()

    def next(self) -> Future:
        if self._timer.is_canceled():
            self._timer.reset()
        future = Future(executor=self._node.executor)
        self._awaited.append(future)
        return future

    def _wake_awaited(self) -> None:
        if not self._awaited:
            self._timer.cancel()
        awaited, self._awaited = self._awaited, []
        for future in awaited:
            future.set_result(None)
