"""Coroutines of a node that wait for the next tick of a timer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future


def steady_timer(node: Node, period_s: float, callback: Callable[[], Any]) -> Any:
    """Call back every ``period_s`` of a steady clock."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class Ticks:
    """Ticks of a steady timer, which rests while no coroutine waits for one."""

    def __init__(self, node: Node, period_s: float) -> None:
        self._node = node
        self._awaited: list[Future] = []
        self._timer = steady_timer(node, period_s, self._tick)
        self._timer.cancel()

    def next(self) -> Future:
        if self._timer.is_canceled():
            self._timer.reset()
        future = Future(executor=self._node.executor)
        self._awaited.append(future)
        return future

    def _tick(self) -> None:
        if not self._awaited:
            self._timer.cancel()
        awaited, self._awaited = self._awaited, []
        for future in awaited:
            future.set_result(None)
