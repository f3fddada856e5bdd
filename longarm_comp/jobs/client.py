"""A client of an arm's graph: sends joints, waits for rest, collects sightings of the tip.

It uses one executor in the caller's thread. Every wait ends at once when ``stop`` is set.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import joints_of, sighting_of
from longarm_comp.nodes.orders import Stamps, order_id
from longarm_comp.nodes.stamps import stamp_ns
from longarm_interfaces.msg import DriverState, Motion

_ANSWER_S = 60.0
"""A node that is starting beside six others on two cores has answered by then."""
_ASK_AGAIN_S = 2.0
"""Without an answer for so long, a request that may be served twice is sent again."""


Client = TypeVar("Client", bound="GraphClient")


class Interrupted(JobError):  # noqa: N818
    """The caller's stop event was set."""

    exit_code = 130


class DriverStopped(JobError):  # noqa: N818
    """The driver is held, in fault or in emergency stop.

    Attributes:
        held: by the hold service, so that somebody means to go on.
    """

    def __init__(self, state: DriverState) -> None:
        self.held = state.state == DriverState.HOLDING
        leads_on = "`longarm status` tells more, `longarm reset` leads on"
        super().__init__(
            f"the driver {_STOPPED[state.state]} ({leads_on})", said=state.message or "nothing"
        )


_STOPPED = {
    DriverState.HOLDING: "is held",
    DriverState.FAULT: "stopped with a fault",
    DriverState.ESTOP: "is in emergency stop",
}


def drivers(node: Node) -> int:
    """How many servo drivers there are in a node's namespace."""
    return node.count_publishers(node.resolve_topic_name(graph.DRIVER_STATE.name))


class GraphClient:
    """A node on a graph: waits, services. Use as a context manager.

    Args:
        stop: ends every wait with `Interrupted`.
    """

    def __init__(
        self, namespace: str = "", stop: threading.Event | None = None, name: str = "longarm_client"
    ) -> None:
        self.stop = stop or threading.Event()
        self.context = rclpy.Context()
        rclpy.init(context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = Node(
            name, context=self.context, namespace=namespace, start_parameter_services=False
        )
        self.executor.add_node(self.node)

    def __enter__(self: Client) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self.context.try_shutdown()

    def until(self, condition: Callable[[], Any], within_s: float, what: str) -> Any:
        """Spin until a condition is truthy and return its value."""
        end = time.monotonic() + within_s
        while not (found := condition()):
            if self.stop.is_set():
                raise Interrupted("interrupted")
            if time.monotonic() > end:
                raise JobError(f"{what}: not within {within_s:g} s")
            self.executor.spin_once(timeout_sec=0.01)
        return found

    @contextmanager
    def putting_back(self) -> Iterator[None]:
        """``stop`` ends no wait meanwhile: for what must be put back after an interruption."""
        stop, self.stop = self.stop, threading.Event()
        try:
            yield
        finally:
            self.stop = stop

    def spin(self, seconds: float) -> None:
        """Serve callbacks for a number of seconds. Raises Interrupted."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() >= end, seconds + 60.0, "waiting")

    def call(
        self, client: Any, request: Any, within_s: float = _ANSWER_S, *, again: bool = False
    ) -> Any:
        """Call a service and return its response.

        The middleware drops an answer to a client that the server has not matched yet.

        Args:
            again: ask again where no answer came for a while; for requests that may be served
                twice.
        """
        self.until(client.service_is_ready, within_s, f"nobody offers {client.srv_name}")
        asked = [client.call_async(request)]
        sent = time.monotonic()

        def answered() -> Any:
            nonlocal sent
            if again and time.monotonic() - sent > _ASK_AGAIN_S:
                asked.append(client.call_async(request))
                sent = time.monotonic()
            return next((future for future in asked if future.done()), None)

        try:
            future = self.until(answered, within_s, f"no answer of {client.srv_name}")
        finally:
            for waiting in asked:
                client.remove_pending_request(waiting)
        return future.result()


class ArmClient(GraphClient):
    """One arm on a graph: its joints, the sightings of its tip (or what else tells it), moves."""

    def __init__(
        self, arm: Arm, namespace: str = "", stop: threading.Event | None = None,
        name: str = "longarm_client", tips: graph.Topic = graph.TIP_MEASURED,
    ) -> None:  # fmt: skip
        super().__init__(namespace, stop, name)
        self.arm = arm
        self.joints: np.ndarray | None = None
        self.sightings: list[tuple[int, np.ndarray, np.ndarray]] = []
        """(stamp ns, tip (3,) m or NaN, variance (3,)), newest last."""
        self._trajectory = graph.JOINT_TRAJECTORY.publisher(self.node)
        graph.JOINT_STATES.subscription(self.node, self._on_joints)
        tips.subscription(self.node, self._on_tip)
        self._driver: DriverState | None = None
        self._stamps = Stamps(self.node.get_clock())
        self._sent, self._refused, self._reached = "", "", False
        self._way: tuple[str, dict[str, float]] = "", {}
        self._at: dict[str, float] = {}
        graph.MOTION.subscription(self.node, self._on_motion)
        self._states = graph.DRIVER_STATE.subscription(self.node, self._on_state)

    def _on_joints(self, message: JointState) -> None:
        try:
            q = joints_of(message, self.arm, "joint_states")
        except InputError:
            return
        self.joints = q

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        xyz, variance = sighting_of(message)
        self.sightings.append((stamp_ns(message.header.stamp), xyz, variance))
        del self.sightings[:-200]

    def ready(self, within_s: float = 30.0, *, tip: bool = True) -> None:
        """Wait for joint states, a ready driver and, with ``tip``, a sighting of the tip.

        Raises:
            DriverStopped: the driver is held, in fault or in emergency stop.
        """
        running = "does `longarm up` run, in this namespace and ROS_DOMAIN_ID?"
        self.until(lambda: self.joints is not None, within_s, f"no joint_states ({running})")
        # a killed driver is counted for up to 20 s
        several = "two drivers are on this graph: end one `longarm up`"
        self.until(lambda: drivers(self.node) < 2, within_s, several)
        self.until(self._driver_hears, within_s, "no driver listens to joint_trajectory")
        self.until(self.driver_takes, within_s, "the driver is not ready (`longarm status`)")
        if tip:
            pictures = "do the cameras publish left|right/image_raw and camera_info?"
            self.until(lambda: self.sightings, within_s, f"no tip_measured ({pictures})")

    def _driver_hears(self) -> bool:
        """Whether everybody who listens to commands is matched, and not only kinematics does."""
        topic = self.node.resolve_topic_name(graph.JOINT_TRAJECTORY.name)
        ends = self.node.get_subscriptions_info_by_topic(topic)
        driver = any(end.node_name not in ("kinematics", self.node.get_name()) for end in ends)
        return driver and self._trajectory.get_subscription_count() >= len(ends)

    def _driver_takes(self) -> bool:
        """Whether the driver tells that it takes trajectories; true of one that never tells."""
        if self._driver is None:
            return self.node.count_publishers(self._states.topic_name) == 0
        return self._driver.state in (DriverState.READY, DriverState.MOVING)

    def _on_state(self, message: DriverState) -> None:
        self._driver = message

    def _on_motion(self, message: Motion) -> None:
        if message.event == Motion.ACCEPTED and message.points:
            names, end = list(message.start.name), message.points[-1].positions
            self._way, self._at = (message.id, dict(zip(names, end, strict=True))), {}
        elif message.event == Motion.REACHED and message.id == self._way[0]:
            self._at = self._way[1]
        if message.id == self._sent:
            self._reached |= message.event == Motion.REACHED
            self._refused = message.message if message.event == Motion.REFUSED else ""

    def driver_takes(self) -> bool:
        """Whether the driver takes trajectories.

        Raises:
            DriverStopped: it is held, in fault or in emergency stop.
        """
        if self._driver is not None and self._driver.state in _STOPPED:
            raise DriverStopped(self._driver)
        return self._driver_takes()

    # ------------------------------------------------------------------ moving

    def send(self, path: np.ndarray, move_s: float = 0.5) -> int:
        """Command way-points (k, n) with a stop at each. The driver keeps its limits.

        Returns:
            The stamp (ns) of the command.
        """
        points = []
        for k, q in enumerate(path, 1):
            whole = int(k * move_s)
            after = Duration(sec=whole, nanosec=round((k * move_s - whole) * 1e9))
            points.append(
                JointTrajectoryPoint(
                    positions=q.tolist(), velocities=[0.0] * self.arm.n, time_from_start=after
                )
            )
        sent = JointTrajectory(joint_names=list(self.arm.joint_names), points=points)
        sent.header.stamp = self._stamps.next()
        self._sent, self._refused, self._reached = order_id(sent), "", False
        self._trajectory.publish(sent)
        return stamp_ns(sent.header.stamp)

    def arrive(
        self,
        path: np.ndarray,
        tolerance: np.ndarray,
        dwell_s: float,
        within_s: float,
        start: np.ndarray | None = None,
    ) -> int:
        """Wait until the joints rest within a tolerance (n,) of the end of a path (k, n).

        Servos that give way may stay farther off: then they are there when the driver says so.

        If the arm was there already and the path leads away and back, it must have left first.

        Args:
            start: (n,) where the joints stood before the command; where they stand now if not
                given. A move may be over before this is called.

        Returns:
            The moment (ns, the graph's clock) from which the arm was at rest.
        """
        q = path[-1]
        inside_since: list[float] = []
        stays = (np.abs(path - q) <= tolerance).all()  # no way-point leads away
        came = start is not None and (np.abs(start - q) > tolerance).any()
        away = [bool(stays or came)]

        def there() -> bool:
            self.driver_takes()
            if self._refused:
                raise JobError(f"the driver refused the move: {self._refused}")
            inside = self.joints is not None and (
                bool((np.abs(self.joints - q) <= tolerance).all()) or self._told_at(q)
            )
            away[0] |= not inside or self._reached  # a passage may be too short to be heard of
            if not inside or not away[0]:
                inside_since.clear()
            elif not inside_since:
                inside_since.append(time.monotonic())
            return bool(inside_since) and time.monotonic() - inside_since[0] >= dwell_s

        self.until(there, within_s, "the joints did not come to rest where they were sent")
        return int(self.node.get_clock().now().nanoseconds)

    def _told_at(self, q: np.ndarray) -> bool:
        """Whether the driver's last word is that the arm rests where it was sent: at q (n,)."""
        held = [self._at.get(name, np.nan) for name in self.arm.joint_names]
        return bool((np.abs(q - held) < SAME_POSE).all())

    def look(self, after_ns: int, count: int, within_s: float) -> list[np.ndarray]:
        """Up to ``count`` sightings (3,) taken after a time (ns), without lost ones.

        Where the marker is lost in twice as many pictures in a row, it is not waited for.
        """

        def taken() -> list[np.ndarray]:
            return [xyz for xyz in told() if np.isfinite(xyz).all()]

        def told() -> list[np.ndarray]:
            return [xyz for ns, xyz, _ in self.sightings if ns > after_ns]

        def over() -> bool:
            good = len(taken())
            lost = not good and len(told()) >= 2 * count
            return good >= count or lost or time.monotonic() > end

        end = time.monotonic() + within_s
        self.until(over, within_s + 60.0, "sightings")
        return taken()
