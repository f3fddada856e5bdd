"""Fresh targets through the `compensate` service, executed, and where the tip really went."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters

from longarm_comp.core.compensation.compensate import Method
from longarm_comp.core.errors import JobError
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.collect import Pace
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.images import stamp_ns
from longarm_comp.nodes.messages import joints_of
from longarm_interfaces.srv import Compensate

_FRESH_NS = 50_000_000


@dataclass(frozen=True, eq=False)
class Trial:
    """Targets as they came out.

    Attributes:
        name: what was compensated, as in `table`.
        target: (N, 3) m.
        seen: (N, 3) mean sighting of the cameras, NaN where the marker was lost.
        true: (N, 3) the simulation's own tip: no compensation can know it.
        status: (N,) of the service.
    """

    name: str
    target: np.ndarray
    seen: np.ndarray
    true: np.ndarray
    status: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """(M, 3) measured - target where the marker was seen, m."""
        error = self.seen - self.target
        return error[np.isfinite(error).all(axis=1)]

    @property
    def true_error(self) -> np.ndarray:
        """(N, 3) true - target, m."""
        return self.true - self.target

    def count(self, status: int) -> int:
        """How many targets ended with a status of the service."""
        return int((self.status == status).sum())


class TargetRunner:
    """Drives targets on a graph with a simulated arm."""

    def __init__(self, client: ArmClient, pace: Pace) -> None:
        self._client, self._pace = client, pace
        self._compensate = graph.COMPENSATE.client(client.node)
        self._set = client.node.create_client(SetParameters, "kinematics/set_parameters")
        self._truth: list[tuple[int, np.ndarray]] = []
        client.node.create_subscription(PointStamped, "simulated_arm/true_tip", self._on_truth, 20)

    def _on_truth(self, message: PointStamped) -> None:
        p = message.point
        self._truth.append((stamp_ns(message.header.stamp), np.array([p.x, p.y, p.z])))
        del self._truth[:-20]

    def ready(self, target: np.ndarray, within_s: float) -> None:
        """Wait until kinematics knows the joints, so that it can answer for a target (3,), m.

        Raises:
            JobError: not within the time. Interrupted: the client was stopped.
        """
        client = self._client
        topic = client.node.resolve_topic_name(graph.JOINT_STATES.name)

        def listens() -> bool:
            ends = client.node.get_subscriptions_info_by_topic(topic)
            return any(end.node_name == "kinematics" for end in ends)

        def knows() -> bool:
            answer = self._ask(target, execute=False)
            return bool(answer.status != Compensate.Response.NOT_READY)

        self.choose(Method.NONE)
        client.until(listens, within_s, "kinematics does not listen to joint_states")
        client.until(knows, within_s, "kinematics has no joint_states")

    def choose(self, method: Method) -> None:
        """Say what the kinematics node shall compensate."""
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=method.value)
        request = SetParameters.Request(parameters=[Parameter(name="method", value=value)])
        answer = self._client.call(self._set, request)
        if not answer.results[0].successful:
            raise JobError(answer.results[0].reason, method=method.value)

    def run(
        self,
        name: str,
        targets: np.ndarray,
        method: Method,
        progress: Callable[[str, float], None] = lambda text, share: None,
    ) -> Trial:
        """Send every target (N, 3), m, and measure where the tip comes to rest.

        Raises:
            JobError: a target was refused, or the arm did not arrive.
        """
        self.choose(method)
        rows = []
        for k, target in enumerate(targets):
            progress(name, k / len(targets))
            rows.append(self._one(k, target))
        seen, true, status = (np.array(column) for column in zip(*rows, strict=True))
        return Trial(name, targets, seen, true, status)

    def _one(self, k: int, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        client, pace = self._client, self._pace
        answer = self._ask(target, execute=True)
        if not answer.success:
            raise JobError(f"target {k} was refused: {answer.message}", status=answer.status)
        stops = (answer.run_up, answer.command) if answer.run_up.name else (answer.command,)
        path = np.array([joints_of(stop, client.arm, "compensate") for stop in stops])
        client.spin(0.05)
        tolerance = np.full(client.arm.n, pace.tolerance)
        rest = client.arrive(path, tolerance, pace.dwell_s, pace.arrive_s) + _FRESH_NS
        looks = client.look(rest, pace.sightings, pace.look_s)
        self._truth_since(rest)
        seen = np.mean(looks, axis=0) if looks else np.full(3, np.nan)
        return seen, self._truth[-1][1], int(answer.status)

    def _ask(self, target: np.ndarray, *, execute: bool) -> Compensate.Response:
        pose = PoseStamped()
        pose.header.frame_id = "base"
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = target.tolist()
        request = Compensate.Request(target=pose, position_only=True, execute=execute)
        return self._client.call(self._compensate, request)

    def _truth_since(self, ns: int) -> None:
        self._client.until(
            lambda: self._truth and self._truth[-1][0] > ns, 10.0, "no true_tip of the simulation"
        )
