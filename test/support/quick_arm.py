"""An arm on a graph that goes where it is sent in no time: driver and cameras of a test's own."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from nodes_bench import PATIENCE_S
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from trajectory_msgs.msg import JointTrajectory
from walking import Walk

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.frame_tree import carry_place
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import Pace
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_ns, stamp_of
from longarm_comp.nodes.messages import joints_message
from longarm_comp.nodes.orders import order_id
from longarm_interfaces.msg import DriverState, Motion

QUICK = Pace(sightings=1, dwell_s=0.1, move_s=0.05, look_s=PATIENCE_S)
"""Short visits; a busy machine may be late with its sightings."""
_PERIOD_S = 0.015
_TRIMS_AFTER = 60
"""Cycles that it stands at the end of a way before it trims its joints."""


class QuickArm:
    """Takes a step of its way a cycle; a sighting a cycle, where the marker is seen.

    Args:
        arm: whose joints.
        sees: whether the cameras see the marker at joints (n,).
        tip: (3,) m at joints (n,) that arrived from sides (n,); as declared where not given.
        frame: of the sightings; stands: (4, 4) of the arm's base in it.

    Attributes:
        ahead_s: by how much the clock of the cameras is ahead.
        trim: (n,) rad, m by which it moves on some time after it came to the end of a way.
    """

    def __init__(
        self,
        arm: Arm,
        sees: Callable[[np.ndarray], bool],
        tip: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
        frame: str = "base",
        stands: np.ndarray | None = None,
    ) -> None:
        self.arm, self.sees = arm, sees
        self._frame, self._stands = frame, np.eye(4) if stands is None else stands
        self.ahead_s, self.trim = 0.0, np.zeros(arm.n)
        self.visited: list[np.ndarray] = []
        self.heard: list[Any] = []
        model = declared_model(arm)
        self.tip = tip or (lambda q, side: model.tip(q))
        self._walk, self._side = Walk(arm), np.ones(arm.n)
        self._look(arm.mid)
        self._id = ""
        self._state, self.stops = DriverState.READY, 0
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node("quick_arm", context=self.context)
        self._joints = graph.JOINT_STATES.publisher(self.node)
        self._tips = graph.TIP_MEASURED.publisher(self.node)
        self._temperature = graph.TEMPERATURE.publisher(self.node)
        self._states = graph.DRIVER_STATE.publisher(self.node)
        self._motions = graph.MOTION.publisher(self.node)
        graph.JOINT_TRAJECTORY.subscription(self.node, self._on_trajectory)
        graph.COLLECT_PROGRESS.subscription(self.node, self.heard.append)
        self.node.create_timer(_PERIOD_S, self._cycle)
        self.hold(False)

    def stand(self, q: np.ndarray) -> None:
        """Have gone to joints (n,), as somebody moves it by hand."""
        self.move([q])
        while self._walk.ahead:
            time.sleep(_PERIOD_S)

    def move(self, way: Iterable[np.ndarray]) -> None:
        """Be on a way of joints (n,)."""
        self._walk.go(way)

    def _look(self, was: np.ndarray) -> None:
        """See the tip where the arm stands now, after it was at joints ``was`` (n,)."""
        q = self._walk.q
        self._side = np.where(q == was, self._side, np.sign(q - was))
        self.true = self.tip(q, self._side)
        self._tip = carry_place(self._stands, self.true) if self.sees(q) else np.full(3, np.nan)

    def hold(self, on: bool, state: int = DriverState.HOLDING) -> None:
        """Hold the arm where it is, or let it go on; or another state in which it is stopped."""
        self._state = state if on else DriverState.READY
        self.stops += 1
        if on:
            self._walk.ahead.clear()
        self._tell()

    def _tell(self) -> None:
        self._states.publish(
            DriverState(state=self._state, message="by the test", stops=self.stops)
        )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        told = Motion(id=order_id(message), event=Motion.ACCEPTED)
        if self._state != DriverState.READY:
            told.event, told.message = Motion.REFUSED, "held"
        else:
            self._id = told.id
            way = [np.array(point.positions) for point in message.points]
            trimmed = [way[-1]] * _TRIMS_AFTER + [way[-1] + self.trim] if self.trim.any() else []
            self._walk.go(way + trimmed)
            told.start = joints_message(self.arm, self._walk.q)
            told.points = message.points
            self.visited.append(self._walk.ahead[-1])
        self._motions.publish(told)

    def _cycle(self) -> None:
        was = self._walk.q
        if self._walk.step():
            self._look(was)
            if not self._walk.ahead:
                there = joints_message(self.arm, self._walk.q)
                self._motions.publish(Motion(id=self._id, event=Motion.REACHED, joints=there))
        self._tell()
        now = self.node.get_clock().now().to_msg()
        self._joints.publish(joints_message(self.arm, self._walk.q, now))
        warm = Temperature(temperature=22.0)
        warm.header.stamp = now
        self._temperature.publish(warm)
        seen = PoseWithCovarianceStamped()
        seen.header.stamp = stamp_of(stamp_ns(now) + round(1e9 * self.ahead_s))
        seen.header.frame_id = self._frame
        x, y, z = self._tip.tolist()
        seen.pose.pose.position = Point(x=x, y=y, z=z)
        no_turn = [1e-8] * 3 + [0.0] * 3  # it measures no orientation
        seen.pose.covariance = np.diag(no_turn).ravel().tolist()
        self._tips.publish(seen)


@contextlib.contextmanager
def quick_arm(
    arm: Arm,
    sees: Callable[[np.ndarray], bool],
    tip: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    **tracker: Any,
) -> Iterator[QuickArm]:
    """The arm on the graph, in a thread of its own."""
    made = QuickArm(arm, sees, tip, **tracker)
    executor = SingleThreadedExecutor(context=made.context)
    executor.add_node(made.node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield made
    finally:
        executor.shutdown()
        thread.join()
        made.node.destroy_node()
        made.context.try_shutdown()
