"""A bare rclpy node that answers like the kinematics node at once, to measure DDS alone.

``python bench/ros_echo.py --ros-args -r __ns:=/some_namespace``
"""

from __future__ import annotations

import sys
from types import SimpleNamespace

from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.nodes.node import run
from longarm_interfaces.srv import Compensate

_NAMES = [f"joint{k}" for k in range(1, 8)]
_VALUES = [0.1 * k for k in range(1, 8)]


class Echo(Node):
    """Topic to topic, and the service, with messages of the same size."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__("echo")
        self.health = SimpleNamespace(fault=lambda error: self.get_logger().error(str(error)))
        self.exit_code = 0
        self._out = self.create_publisher(JointTrajectory, "echo_trajectory", QoSProfile(depth=100))
        self.create_subscription(PoseStamped, "echo_target", self._on_target, QoSProfile(depth=100))
        self.create_service(
            Compensate, "echo_compensate", self._on_compensate, qos_profile=QoSProfile(depth=100)
        )

    def _on_target(self, message: PoseStamped) -> None:
        point = JointTrajectoryPoint(positions=_VALUES)
        self._out.publish(JointTrajectory(joint_names=_NAMES, points=[point]))

    def _on_compensate(
        self, request: Compensate.Request, response: Compensate.Response
    ) -> Compensate.Response:
        response.ideal = JointState(name=_NAMES, position=_VALUES)
        response.command = JointState(name=_NAMES, position=_VALUES)
        response.pseudo_target = request.target
        return response

    def close(self) -> None:
        """Nothing was started."""


if __name__ == "__main__":
    sys.exit(run(Echo))
