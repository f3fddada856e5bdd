"""The clock that the nodes of a soak go by: /clock, which may stand, run fast and jump."""

import time

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from longarm_comp.nodes.clock import stamp_of, steady_timer

_PERIOD_S = 0.02
_FINE = 1_000_000
"""The last digits of a stamp, ns, are a running number: no two stamps are the same."""


class SimClock:
    """Publishes /clock from a node, as long as the node is spun.

    Attributes:
        rate: seconds on it per second; 0 stands.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(Clock, "/clock", 10)
        self._now_ns, self._told_s, self.rate = time.time_ns(), time.monotonic(), 1.0
        self._stamps = 0
        steady_timer(node, _PERIOD_S, self._tell)

    def jump(self, seconds: float) -> None:
        """Go on from another time, also an earlier one."""
        self._now_ns += int(1e9 * seconds)

    def stamp_ns(self) -> int:
        """The time now, ns, to a millisecond; different at every call."""
        self._stamps = (self._stamps + 1) % _FINE
        return self._now_ns // _FINE * _FINE + self._stamps

    def _tell(self) -> None:
        now_s = time.monotonic()
        self._now_ns += int(1e9 * self.rate * (now_s - self._told_s))
        self._told_s = now_s
        self._publisher.publish(Clock(clock=stamp_of(self._now_ns)))
