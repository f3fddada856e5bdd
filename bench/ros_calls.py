"""The caller's side of the latency benchmark: one call at a time, timed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from bench.slow_path import slow_path
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.expansion import Expansion, Nearby
from longarm_comp.core.errors import JobError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_message, pose_message
from longarm_comp.nodes.predictor_client import ServedPredictor
from longarm_interfaces.msg import Compensation
from longarm_interfaces.srv import Compensate

_POSES = 400
_DEPTH = QoSProfile(depth=100)  # above the bursts: a queue on the way that overflows loses targets
_PATIENCE_S = 10.0


class Calls:
    """Timed calls. Each starts after the answer to the one before has been published."""

    def __init__(self, arm: Arm, namespace: str, predictor: Path) -> None:
        self._client = ArmClient(arm, namespace, name="caller")
        node = self._client.node
        self._arm, self._learned = arm, ServedPredictor.read(str(predictor), arm)
        self._targets = slow_path(arm, _POSES)
        at = Header(frame_id="base")
        self._poses = [PoseStamped(header=at, pose=pose_message(m)) for m in self._targets]
        self._model, self._known = declared_model(arm), _Known(arm.n)
        ik.warm_up(self._model)
        self._got = self._echoed = self._predicted = self._compensations = 0
        self._joints = graph.JOINT_STATES.publisher(node)
        self._target = graph.TARGET_POSE.publisher(node)
        self._echo_target = node.create_publisher(PoseStamped, "echo_target", _DEPTH)
        node.create_subscription(
            JointTrajectory, graph.JOINT_TRAJECTORY.name, self._on_trajectory, _DEPTH
        )
        node.create_subscription(JointTrajectory, "echo_trajectory", self._on_echo, _DEPTH)
        node.create_subscription(
            Compensation, graph.COMPENSATION.name, self._on_compensation, _DEPTH
        )
        self._compensate = graph.COMPENSATE.client(node)
        self._echo_compensate = node.create_client(
            Compensate, "echo_compensate", qos_profile=_DEPTH
        )
        self._predict = graph.PREDICT_ERROR.client(node)
        self._stand = arm.mid
        node.create_timer(0.05, self._tell_joints)

    def close(self) -> None:
        """Leave the graph."""
        self._client.__exit__(None, None, None)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        self._got += 1
        self._stand = np.array(message.points[0].positions)

    def _tell_joints(self) -> None:
        self._joints.publish(joints_message(self._arm, self._stand))

    def _on_echo(self, message: JointTrajectory) -> None:
        self._echoed += 1

    def _on_compensation(self, message: Compensation) -> None:
        self._compensations += 1

    def _on_prediction(self, message: Any) -> None:
        self._predicted += 1

    def _until(self, condition: Callable[[], Any], within_s: float = _PATIENCE_S) -> None:
        self._client.until(condition, within_s, "no answer")

    def warm_up(self) -> None:
        """Wait until all nodes are up, and repeat all calls a few times."""
        for service in (self._compensate, self._echo_compensate, self._predict):
            self._until(service.service_is_ready, 60.0)
        for topic in (self._target, self._echo_target, self._joints):
            self._until(topic.get_subscription_count, 60.0)
        self._client.spin(0.5)
        first = Compensate.Request(target=self._poses[0])

        def through() -> bool:  # kinematics too has found the predictor and heard the joints
            answer = self._call(self._compensate, first)[1]
            return bool(answer.status == Compensate.Response.SUCCESS)

        self._until(through, 60.0)
        for i in range(20):
            for call in (self.service, self.topic, self.topic_echo, self.service_echo):
                call(i)

    def topic(self, i: int) -> float:
        """`target_pose` to `joint_trajectory`."""
        want, published = self._got + 1, self._compensations + 1
        begin = time.perf_counter()
        self._target.publish(self._poses[i % _POSES])
        self._until(lambda: self._got >= want)
        seconds = time.perf_counter() - begin
        self._until(lambda: self._compensations >= published)
        return seconds

    def topic_echo(self, i: int) -> float:
        """The same through the echo."""
        want = self._echoed + 1
        begin = time.perf_counter()
        self._echo_target.publish(self._poses[i % _POSES])
        self._until(lambda: self._echoed >= want)
        return time.perf_counter() - begin

    def service(self, i: int) -> float:
        """`compensate`, from the last joint states."""
        published = self._compensations + 1
        seconds = self.alone(i)
        self._until(lambda: self._compensations >= published)
        return seconds

    def alone(self, i: int) -> float:
        """`compensate` whatever else is published."""
        request = Compensate.Request(target=self._poses[i % _POSES])
        seconds, answer = self._call(self._compensate, request)
        if answer.status != Compensate.Response.SUCCESS:
            raise JobError(f"a target of the benchmark was refused: {answer.message}")
        return seconds

    def await_flood(self) -> None:
        """Wait until targets of somebody else are answered."""
        count = self._compensations
        self._until(lambda: self._compensations > count, 60.0)

    @property
    def namespace(self) -> str:
        """The graph's namespace."""
        return str(self._client.node.get_namespace())

    def service_echo(self, i: int) -> float:
        """The same through the echo."""
        request = Compensate.Request(target=self._poses[i % _POSES])
        return self._call(self._echo_compensate, request)[0]

    def predict(self, i: int) -> float:
        """The learned error alone, as `kinematics` computes it for a target."""
        spread = 0.3 * (self._arm.upper - self._arm.lower) * np.sin(i + np.arange(self._arm.n))
        begin = time.perf_counter()
        self._learned.expand(self._arm.mid + spread, (0.0,) * self._arm.n, math.nan, math.nan)
        return time.perf_counter() - begin

    def compute(self, i: int) -> float:
        """The computation of `kinematics` for a target, with a known learned error."""
        begin = time.perf_counter()
        target = self._targets[i % _POSES]
        answer = compensate(self._model, Nearby(self._known), target, seed=self._stand)[0]
        if not answer.success:
            raise JobError(f"a target of the benchmark was refused: {answer.reason}")
        return time.perf_counter() - begin

    def _call(self, service: Any, request: Any) -> tuple[float, Any]:
        begin = time.perf_counter()
        future = service.call_async(request)
        self._until(future.done)
        return time.perf_counter() - begin, future.result()

    def predictions_per_target(self, count: int) -> float:
        """Number of learned errors that are looked up per target."""
        graph.PREDICTED_ERROR.subscription(self._client.node, self._on_prediction)
        self._client.spin(1.0)
        before = self._predicted
        for i in range(count):
            self.topic(i)
        self._client.spin(0.2)
        return (self._predicted - before) / count

    def rate(self, burst: int, echo: bool = False) -> float:
        """Targets per second that graph or echo process from a queue; above it queues grow."""
        service = self._echo_compensate if echo else self._compensate
        begin = time.perf_counter()
        asked = [
            service.call_async(Compensate.Request(target=self._poses[i % _POSES], execute=True))
            for i in range(burst)
        ]
        self._until(lambda: all(future.done() for future in asked), 60.0)
        return burst / (time.perf_counter() - begin)


class _Known:
    """A constant expected error of 3 mm, at negligible cost."""

    def __init__(self, n: int) -> None:
        error, sigma = np.full(3, 3e-3 / 3**0.5), np.full(3, 1e-4)
        self._told = Expansion(error, sigma, True, "", np.zeros((3, n)), np.full(n, np.inf))

    def __call__(self, q: np.ndarray, context: Context) -> Expansion:
        return self._told
