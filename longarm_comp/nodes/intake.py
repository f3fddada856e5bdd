"""Which of the trajectories that a driver hears may still move the arm."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from rclpy.node import Node
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.orders import Freshness, order_id
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.stamps import stamp_ns

PARAMS = (
    Param("order_max_age_s", 2.0, "older trajectories and goals move nothing", 0.01, 60.0),
    Param("unstamped", False, "take up trajectories with the stamp 0 too (docs/ros.md)"),
)


_NO_STAMP = "header.stamp: 0; allowed: when it was sent, or set unstamped of servo_driver to true"


class _Site(Protocol):
    """What the intake needs of the driver."""

    @property
    def following(self) -> str:
        """Id of the trajectory that is being followed; empty while none is."""

    def take(self, message: JointTrajectory, name: str) -> None:
        """Check and follow a trajectory; what becomes of it is told by its id ``name``."""

    def refuse(self, name: str, why: str) -> None:
        """Tell that a trajectory is not taken up."""


class Intake:
    """Hears `joint_trajectory` and `withdrawn`."""

    def __init__(self, node: Node, site: _Site, max_age_s: float, *, unstamped: bool) -> None:
        self._site, self._unstamped = site, unstamped
        self._fresh = Freshness(node, max_age_s)
        # Withdrawn ids that are remembered: more than can wait
        self._withdrawn: deque[str] = deque(maxlen=100)
        graph.WITHDRAWN.subscription(node, self._on_withdrawn)
        # Trajectories that may wait: a later one replaces those before it anyway
        graph.JOINT_TRAJECTORY.subscription(node, self._on_trajectory, depth=10)

    def too_old(self, message: JointTrajectory) -> str:
        """Why a trajectory is too old to move the arm; empty if it is not. A stop never is."""
        return self._fresh.too_old(message.header.stamp) if message.points else ""

    def _on_trajectory(self, message: JointTrajectory) -> None:
        name = order_id(message)
        if message.points and not (self._unstamped or stamp_ns(message.header.stamp)):
            self._site.refuse(name, _NO_STAMP)
        elif name in self._withdrawn:
            self._site.refuse(name, "its sender has withdrawn it")
        else:
            self._site.take(message, name)

    def _on_withdrawn(self, message: String) -> None:
        self._withdrawn.append(message.data)
        if message.data and message.data == self._site.following:
            self._site.take(JointTrajectory(), f"{message.data} withdrawn")
