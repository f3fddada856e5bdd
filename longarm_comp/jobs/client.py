"""A client of an arm's graph: sends joints, waits for rest, collects sightings of the tip."""

import math
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.history import SAME_POSE
from longarm_comp.core.data.rest import JOINT_REST
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.reduced_speed import REDUCED_SPEED, times_at_reduced_speed
from longarm_comp.jobs.graph_client import (
    ANSWER_S,
    FOUND_S,
    Call,
    GraphClient,
    Interrupted,
    count_drivers,
)
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import sleepless_s, stamp_ns, told_ns
from longarm_comp.nodes.messages import driver_words, joints_of, sighting_of, trajectory_message
from longarm_comp.nodes.orders import DRIVER_SILENT_S, Stamps, order_id
from longarm_interfaces.msg import DriverState, Motion


@dataclass(frozen=True)
class Pace:
    """The time that a visit may take, and what counts as rest.

    Attributes:
        sightings: number of sightings that are averaged at each pose.
        dwell_s: how long the joints must rest before the first sighting counts.
        move_s: requested duration of the motion to each way-point. The driver takes longer if its
            limits require it.
        arm_speed: highest speed of any part of the arm, m/s, if another program drives it.
        arrive_s: longest wait for the end of a move, beyond its duration.
        look_s: longest wait for the sightings.
        tolerance: largest difference between commanded and reported joints at rest, rad or m; one
            for all joints or (n,).
    """

    sightings: int = 5
    dwell_s: float = 0.3
    move_s: float = 0.5
    arm_speed: float = REDUCED_SPEED
    arrive_s: float = 60.0
    look_s: float = 5.0
    tolerance: float | np.ndarray = JOINT_REST

    def __post_init__(self) -> None:
        given = (
            ("sightings", self.sightings, 1),
            ("dwell", self.dwell_s, 0),
            ("move", self.move_s, 0),
        )
        for name, value, least in given:
            if value < least:
                raise InputError("collect", f"--{name}", value, f"at least {least}")


TOLD_S = 3.0
"""Time at rest, s, after which a move counts as ended without the report of the driver: of a servo
that trembles it reports none."""
GIVES_WAY = 0.05
"""Largest distance of a joint from its command that a yielding servo explains, as a share of the
joint's range."""
STOPPED = (DriverState.HOLDING, DriverState.FAULT, DriverState.ESTOP)


class DriverStopped(JobError):  # noqa: N818
    """The driver is held, in fault or in emergency stop, or was so meanwhile."""

    def __init__(self, state: DriverState) -> None:
        self.held = state.state == DriverState.HOLDING  # somebody means to continue
        why = "the arm was stopped meanwhile, or its driver started again"
        if state.state in STOPPED:
            leads_on = "`longarm status` tells more, `longarm reset` leads on"
            why = f"the driver is {driver_words(state.state)} ({leads_on})"
        super().__init__(why, said=state.message or "nothing")


class ArmClient(GraphClient):
    """A client of one arm's graph: receives its joints and sightings of its tip, and moves it."""

    def __init__(
        self,
        arm: Arm,
        namespace: str = "",
        stop: threading.Event | None = None,
        name: str = "longarm_client",
        tips: graph.Topic = graph.TIP_MEASURED,
    ) -> None:
        super().__init__(namespace, stop, name)
        self.arm = arm
        self.joints: np.ndarray | None = None
        self.sightings: list[tuple[int, np.ndarray]] = []
        """(time ns when it was taken, tip (3,) m or NaN), newest last."""
        self.seen_in = ""  # the frame of the last one
        self._trajectory = graph.JOINT_TRAJECTORY.publisher(self.node)
        self._withdrawn = graph.WITHDRAWN.publisher(self.node)
        graph.JOINT_STATES.subscription(self.node, self._on_joints)
        self._tips = tips
        tips.subscription(self.node, self._on_tip)
        self._driver: DriverState | None = None
        self._heard_s = -math.inf  # when it was last heard, sleepless s
        self._stops: tuple[str, int] | None = None  # of which driver, and how many, while it took
        self._stamps = Stamps(self.node.get_clock())
        self._sent, self._refused, self._reached, self._replaced = "", "", False, False
        self._patience_s = 0.0  # how long the last command takes
        self._under_way = False  # accepted, and the driver has not said that it ended
        self._way: tuple[str, dict[str, float]] = "", {}
        self._at: dict[str, float] = {}
        graph.MOTION.subscription(self.node, self._on_motion)
        self._states = graph.DRIVER_STATE.subscription(self.node, self._on_state)

    def _on_state(self, message: DriverState) -> None:
        self._driver, self._heard_s = message, sleepless_s()

    def _on_joints(self, message: JointState) -> None:
        with suppress(InputError):
            self.joints = joints_of(message, self.arm, "joint_states")

    def _on_tip(self, message: PoseWithCovarianceStamped) -> None:
        tip, _ = sighting_of(message)
        now_ns = int(self.node.get_clock().now().nanoseconds)
        self.sightings.append((told_ns(message.header.stamp, now_ns), tip))
        self.seen_in = message.header.frame_id
        del self.sightings[:-200]

    def ready(self, within_s: float = 30.0, *, tip: bool = True) -> None:
        """Wait for joint states, a ready driver and, with ``tip``, a sighting of the tip.

        Raises:
            DriverStopped: the driver is held, in fault or in emergency stop.
        """

        def driver_hears() -> bool:  # a driver listens to commands, and every listener is connected
            ends = self.node.get_subscriptions_info_by_topic(self._trajectory.topic_name)
            driver = any(end.node_name not in ("kinematics", self.node.get_name()) for end in ends)
            return driver and self._trajectory.get_subscription_count() >= len(ends)

        self._stops = None
        running = "does `longarm up` run in this namespace and ROS_DOMAIN_ID?"
        self.until(lambda: self.joints is not None, within_s, f"no joint_states ({running})")
        # a killed driver is counted for up to 20 s
        several = "two drivers are on this graph: end one `longarm up`"
        self.until(lambda: count_drivers(self.node) < 2, within_s, several)
        self.until(driver_hears, within_s, "no driver listens to joint_trajectory")
        self.until(self.driver_takes, within_s, "the driver is not ready (`longarm status`)")
        if tip:
            hint = ""
            if self._tips is not graph.TIP_BY_READINGS:
                hint = " (do the cameras publish left|right/image_raw and camera_info?)"
            self.until(lambda: self.sightings, within_s, f"no {self._tips.name}{hint}")

    def _on_motion(self, message: Motion) -> None:
        if message.event == Motion.ACCEPTED and message.points:
            names, end = list(message.start.name), message.points[-1].positions
            self._way, self._at = (message.id, dict(zip(names, end, strict=True))), {}
        elif message.event == Motion.REACHED and message.id == self._way[0]:
            self._at = self._way[1]
        if message.id == self._sent:
            self._under_way = message.event == Motion.ACCEPTED
            self._reached |= message.event == Motion.REACHED
            self._replaced |= message.event == Motion.REPLACED
            self._refused = message.message if message.event == Motion.REFUSED else ""

    @property
    def drives_itself(self) -> bool:
        """True if this package's driver drives the arm: it publishes its state and keeps limits."""
        publishers = self.node.count_publishers(self._states.topic_name)
        return self._driver is not None or publishers > 0

    def driver_takes(self, *, held: bool = False) -> bool:
        """Tell whether the driver accepts trajectories; one that publishes no state always does.

        Raises:
            DriverStopped: it is in fault, in emergency stop, or held, or was so since it was last
                asked; ``held`` allows that it is held.
        """
        if self._driver is None:
            return not self.drives_itself
        stopped = self._driver.state in STOPPED
        if stopped and not (held and self._driver.state == DriverState.HOLDING):
            raise DriverStopped(self._driver)
        silent = sleepless_s() - self._heard_s > DRIVER_SILENT_S
        if silent or self._driver.state not in (DriverState.READY, DriverState.MOVING):
            return False
        before, self._stops = self._stops, (self._driver.instance, self._driver.stops)
        if before not in (None, self._stops) and not held:
            raise DriverStopped(self._driver)
        return True

    def ready_to_move(self) -> None:
        """Wait until the driver accepts trajectories: a stop ends a job, whoever ended the stop."""
        self.spin(0.05)  # so that it hears what came while it computed
        self.until(self.driver_takes, FOUND_S, "the driver is not ready (`longarm status`)")

    def send(self, path: np.ndarray, move_s: float = 0.5, arm_speed: float = REDUCED_SPEED) -> int:
        """Command way-points (k, n) with a stop at each.

        This package's driver keeps its own limits. For another driver, the times are chosen so that
        no part of the arm moves faster than ``arm_speed``, m/s.

        Returns:
            The stamp (ns) of the command.

        Raises:
            JobError: another program drives, and no `joint_states` came.
        """
        times: float | np.ndarray = move_s
        if not self.drives_itself:
            if self.joints is None:
                raise JobError("no joint_states: it is not known how long the way is")
            times = times_at_reduced_speed(Model(self.arm), self.joints, path, move_s, arm_speed)
        self._patience_s = float(np.max(times))
        stamp = self._stamps.next()
        sent = trajectory_message(self.arm, path, times, stamp, np.zeros_like(path))
        self._sent, self._refused, self._reached = order_id(sent), "", False
        self._replaced = self._under_way = False
        self._trajectory.publish(sent)
        return stamp_ns(sent.header.stamp)

    def arrive(self, path: np.ndarray, pace: Pace, start: np.ndarray | None = None) -> int:
        """Wait until the joints have rested at a path's end for `dwell_s`; return the time (ns).

        While the driver has not said that the move has ended, it may still trim the joints, and
        they must rest for `TOLD_S`.  The end is reached if the joints are within its tolerance, or
        if the driver says that the arm has reached it: servos that yield may stay farther off. If
        the arm stood there before, and the path leads away and back, it must have left first.

        Args:
            path: (k, n) way-points, rad and m.
            start: (n,) joints before the command; the move may be over before this is called.

        Raises:
            JobError: the driver stopped, refused the command or took another program's, or the
                joints do not arrive in time.
        """
        q, tolerance = path[-1], pace.tolerance
        rest: tuple[float, np.ndarray] | None = None  # since when, and where
        stays = (np.abs(path - q) <= tolerance).all()  # no way-point leads away
        away = stays or (start is not None and (np.abs(start - q) > tolerance).any())

        def there() -> bool:
            nonlocal rest, away
            self.driver_takes()
            if self._refused:
                raise JobError(f"the driver refused the move: {self._refused}")
            if self._replaced:
                raise JobError("another program commanded the arm meanwhile: end one of the two")
            q_now = self.joints
            # The driver's last word may be that the arm rests where it was sent, and that is at q
            end = [self._at.get(name, np.nan) for name in self.arm.joint_names]
            inside = q_now is not None and bool(
                (np.abs(q_now - q) <= tolerance).all() or (np.abs(q - end) < SAME_POSE).all()
            )
            away |= not inside or self._reached  # a passage may be too short to be heard of
            if not inside or not away or q_now is None:
                rest = None
            elif rest is None or (np.abs(q_now - rest[1]) > JOINT_REST).any():
                rest = time.monotonic(), q_now  # it may move within a wide tolerance
            rest_s = max(pace.dwell_s, TOLD_S) if self._under_way else pace.dwell_s
            return rest is not None and time.monotonic() - rest[0] >= rest_s

        self.until(there, pace.arrive_s + self._patience_s, lambda: self._short_of(q, pace))
        return int(self.node.get_clock().now().nanoseconds)

    def _short_of(self, q: np.ndarray, pace: Pace) -> str:
        """Say which joint is farthest from its command (n,), by how much, and what helps."""
        waited = f"the joints did not come to rest at their command within {pace.arrive_s:g} s"
        if self.joints is None:
            return f"{waited}: no joint_states"
        arm, gap = self.arm, np.abs(self.joints - q)
        k = int(np.argmax(gap / pace.tolerance))
        allowed = float(np.broadcast_to(pace.tolerance, gap.shape)[k])
        unit = "m" if arm.slides[k] else "rad"
        said = f"{waited}: {arm.joint_names[k]} is {gap[k]:.2g} {unit} off, allowed {allowed:.2g}"
        if gap[k] <= allowed:
            return f"{said}, but does not stay there"
        if gap[k] > GIVES_WAY * (arm.upper - arm.lower)[k]:
            return f"{said}: does its driver hear joint_trajectory?"
        return f"{said}: servos that give way need --within {1.5 * gap[k]:.1g}"

    def look(
        self, path: np.ndarray, pace: Pace, start: np.ndarray | None, order: str = ""
    ) -> tuple[int, list[np.ndarray]]:
        """Wait for the end of a path as `arrive` does, then collect sightings of the tip.

        The wait ends early if the marker is lost in all of the first ``2 * pace.sightings`` images.
        If `stop` ends the wait for the arm, this package's driver is asked to stop it, where it
        still follows ``order``, an id; empty: what `send` sent last.

        Returns:
            The time (ns) from which sightings count; and the sightings (3,), m, of the marker.
        """
        try:
            self.spin(0.05)  # the driver has taken it up when its joints move
            # A sighting counts if it was taken 50 ms after the joints came to rest
            after_ns = self.arrive(path, pace, start) + 50_000_000
        except Interrupted:
            self._withdraw(order or self._sent)
            raise
        seen: list[np.ndarray] = []

        def over() -> bool:
            nonlocal seen
            told = [xyz for ns, xyz in self.sightings if ns > after_ns]
            seen = [xyz for xyz in told if np.isfinite(xyz).all()]
            lost = not seen and len(told) >= 2 * pace.sightings
            return len(seen) >= pace.sightings or lost

        self.wait(over, pace.look_s)
        return after_ns, seen

    def call_to_move(self, client: Any, request: Any) -> Any:
        """Call a service that may move the arm, once; if `stop` ends the wait, nothing moves it."""
        self.ready_to_move()
        self.until(client.service_is_ready, ANSWER_S, f"nobody offers {client.srv_name}")
        asked = Call(client, request, again=False)
        try:
            return self.until(asked.answer, ANSWER_S, f"no answer of {client.srv_name}")
        except Interrupted:
            self._withdraw("")
            with self.putting_back():  # the answer names what was sent before that
                if (answer := self.wait(asked.answer, 2.0)) is not None:
                    self._withdraw(answer.id)
            raise
        finally:
            asked.close()

    def _withdraw(self, name: str) -> None:
        """Withdraw a trajectory by its id; empty: every target that waits to be executed."""
        self._withdrawn.publish(String(data=name))
        self._withdrawn.wait_for_all_acked(Duration(seconds=1.0))
