"""Tells where the tip stands by the readings of the joints: topic `tip_by_readings`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.stands import TipByReadings, tip_by_readings
from longarm_comp.core.data.rest import JOINT_REST
from longarm_comp.core.model.model import Model
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import OK, Report
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.ticks import steady_timer
from longarm_comp.nodes.worker import Worker

PARAMS = (Param("readings.period_s", 1.0, "between two tip_by_readings; 0: none", 0.0, 60.0),)

Now = Callable[[], tuple[Model, np.ndarray, Context] | None]
"""Model of the commands, readings (n,) and circumstances; None while they are not known."""


class ReadingsTeller:
    """Publishes it every so often while the arm rests, computed on the worker's thread."""

    def __init__(
        self, node: Node, base_frame: str, period_s: float, worker: Worker, now: Now
    ) -> None:
        self._node, self._frame, self._worker, self._now = node, base_frame, worker, now
        self.last: TipByReadings | None = None
        self._before: np.ndarray | None = None
        self._waits = False
        self._tips = graph.TIP_BY_READINGS.publisher(node)
        if period_s:
            steady_timer(node, period_s, self._tick)

    def _tick(self) -> None:
        """One at a time: targets must not wait behind many."""
        now = self._now()
        q, before = None if now is None else now[1], self._before
        self._before = q
        rests = q is not None and before is not None and np.abs(q - before).max() <= JOINT_REST
        if rests and not self._waits:
            self._waits = self._worker.submit(self._in_turn)

    def _in_turn(self) -> None:
        self._waits = False
        self.tell()

    def tell(self) -> TipByReadings | None:
        """Compute and publish it now; None while joints or circumstances are not known."""
        now = self._now()
        if now is None:
            return None
        found = self.last = tip_by_readings(*now)
        message = PoseWithCovarianceStamped()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = self._frame
        point = message.pose.pose.position
        point.x, point.y, point.z = found.tip.tolist()
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = np.nan_to_num(found.doubt.covariance)
        message.pose.covariance = covariance.ravel()
        self._tips.publish(message)
        return found

    def report(self) -> Report:
        """The last one, for diagnostics."""
        return Report(OK, "not known yet" if self.last is None else self.last.said())
