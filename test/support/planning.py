"""A planner in front of `trajectory_compensator`, and a controller behind it, of a test's own."""

from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from nodes_bench import Bench
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from walking import Walk

from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import Ticks
from longarm_comp.nodes.messages import duration, joints_message

TYPE = graph.FOLLOW_PLANNED.type
THEIRS = "arm_controller/follow_joint_trajectory"


class Controller:
    """A joint trajectory controller that goes where it is sent to, and ends as it is told to.

    Its encoders read ``droop`` (rad, m) less than its set-points.
    """

    def __init__(self, stage: Bench, arm: Arm) -> None:
        self.arm, self.got, self.walk = arm, list[Any](), Walk(arm)
        self.ends, self.waits, self.droop = GoalStatus.STATUS_SUCCEEDED, False, 0.0
        self.node, self.ticks = stage.node, Ticks(stage.node, 0.02)
        self.joints = graph.JOINT_STATES.publisher(stage.node)
        self.timer = stage.node.create_timer(0.05, self.tell)
        self.server = ActionServer(
            stage.node, TYPE, THEIRS, self.serve, callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )  # fmt: skip

    def tell(self) -> None:
        self.walk.step()
        now = self.node.get_clock().now().to_msg()
        self.joints.publish(joints_message(self.arm, self.walk.q - self.droop, now))

    async def serve(self, goal: Any) -> Any:
        self.got.append(goal.request)
        goal.publish_feedback(TYPE.Feedback(joint_names=["fed back"]))
        self.walk.go(point.positions for point in goal.request.trajectory.points)
        while (self.waits or self.walk.ahead) and not goal.is_cancel_requested:
            await self.ticks.next()
        if goal.is_cancel_requested:
            self.walk.ahead.clear()
            goal.canceled()
            return TYPE.Result(error_string="halted by the controller")
        if self.ends == GoalStatus.STATUS_SUCCEEDED:
            goal.succeed()
            return TYPE.Result()
        goal.abort()
        return TYPE.Result(error_code=TYPE.Result.PATH_TOLERANCE_VIOLATED, error_string="off")


class Planner:
    """Plans in joints of the declared arm and sends it to `follow_joint_trajectory`."""

    def __init__(self, stage: Bench) -> None:
        self.stage, self.fed, self.health = stage, list[Any](), stage.collect(graph.DIAGNOSTICS)
        self.client = stage.action(TYPE, graph.FOLLOW_PLANNED.name)
        stage.spin(self.ready)

    def ready(self) -> bool:
        """Whether the node says so: everything is compiled."""
        parts = [s for array in self.health for s in array.status if s.name.endswith(": paths")]
        return bool(parts) and parts[-1].message == "ready"

    def send(
        self, names: list[str], path: np.ndarray, seconds: float = 1.0, *,
        stamp: Time | None = None, **more: Any,
    ) -> Any:  # fmt: skip
        """Send a plan, which the node accepts; its goal."""
        sent = self.ask(names, path, seconds, stamp=stamp, **more)
        self.stage.spin(sent.done)
        assert sent.result().accepted
        return sent.result()

    def ask(
        self, names: list[str], path: np.ndarray, seconds: float = 1.0, *,
        stamp: Time | None = None, **more: Any,
    ) -> Any:  # fmt: skip
        times = np.linspace(0.0, seconds, len(path))
        points = [
            JointTrajectoryPoint(positions=q, time_from_start=duration(t))
            for t, q in zip(times.tolist(), path.tolist(), strict=True)
        ]
        trajectory = JointTrajectory(joint_names=names, points=points)
        trajectory.header.stamp = stamp or Time()
        return self.client.send_goal_async(
            TYPE.Goal(trajectory=trajectory, **more), lambda m: self.fed.append(m.feedback)
        )

    def ends(self, goal: Any, status: int) -> Any:
        """Wait for a goal's end, and check it; its result."""
        result = goal.get_result_async()
        self.stage.spin(result.done)
        assert result.result().status == status, result.result().result.error_string
        return result.result().result


def ramp(start: np.ndarray, end: np.ndarray, count: int = 11) -> np.ndarray:
    share = np.linspace(0.0, 1.0, count)[:, None]
    return start + (3 * share**2 - 2 * share**3) * (end - start)
