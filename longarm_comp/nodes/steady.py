"""Timers of loops, supervision and reports. They run on a steady clock, whatever ROS time does.

With ``use_sim_time`` a node's own clock stands still until somebody publishes /clock, and it may
jump. A loop that drives servos or reports on health must not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node


def steady_timer(node: Node, period_s: float, callback: Callable[[], Any]) -> Any:
    """Call back every ``period_s`` of a steady clock."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
