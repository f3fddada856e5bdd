"""Orders that move joints: trajectories on `joint_trajectory` and goals of an action.

The action is `follow_joint_trajectory`, as ROS's joint trajectory controllers offer it. A goal
passes the same checks as a message. Its result follows from the events that the driver publishes on
`motion` for its id.
"""

import hashlib
import itertools
import math
import time
import uuid
from array import array
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from builtin_interfaces.msg import Time
from rclpy.clock import Clock
from rclpy.node import Node
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.devices.servo_arm import ServoReading
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import (
    Ticks,
    sleepless_s,
    stamp_ns,
    stamp_of,
    steady_timer,
    told_age_s,
)
from longarm_comp.nodes.health import THIS_INSTANCE
from longarm_comp.nodes.messages import duration, seconds
from longarm_comp.nodes.params import Param
from longarm_interfaces.msg import DriverState, Motion


def order_id(message: JointTrajectory) -> str:
    """Return the id of a trajectory: its stamp and a hash, so sender and receiver get the same."""
    content = hashlib.blake2s("\n".join(message.joint_names).encode(), digest_size=6)
    for point in message.points:
        after = point.time_from_start
        content.update(array("q", [after.sec, after.nanosec]).tobytes())
        for values in (point.positions, point.velocities, point.accelerations):
            content.update(array("d", values).tobytes() + b"|")
    return f"{stamp_ns(message.header.stamp)}-{content.hexdigest()}"


class Stamps:
    """The stamps of a node's orders: the present time, or the last + 1 ns if the clock stands."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._read, self._last = clock, 0, 0

    def next(self) -> Time:
        before, self._read = self._read, int(self._clock.now().nanoseconds)
        stood = before <= self._read <= self._last
        self._last = self._last + 1 if stood else self._read
        return stamp_of(self._last)


def describe_untimely(clock: Clock, stamp: int, max_age_s: float) -> str:
    """Say why a message with the stamp ``stamp``, ns, is too old or from the future; "" if not."""
    age = 1e-9 * (clock.now().nanoseconds - stamp)
    if abs(age) <= max_age_s:
        return ""
    return f"is {age:.1f} s old" if age > 0 else f"lies {-age:.1f} s in the future"


_DEAF_S = 1.0
"""Absence, s, after which what was said meanwhile may be lost: the middleware keeps few messages of
a topic, and delivers some of them seconds later."""
_WATCH_S = 0.1
"""Longest pause, s, between two looks whether the node runs."""
_DELIVERED_S = 60.0
"""Time, s, after which the middleware has delivered all that waited while the node did not run,
however long that was."""


class Freshness:
    """A limit on the age (s) of the orders that a node accepts.

    The age of an order follows from its stamp and the node's clock. Without a stamp, or in
    simulated time, which may stand still, the order may have waited as long as the node did not run
    (stopped or overloaded). A timer on the node's executor measures this time.

    An order from before the last `begin_anew` is too old at any age, and so is one from before the
    end of an absence in which the node may have missed a stop or a withdrawal.
    """

    def __init__(self, node: Node, max_age_s: float) -> None:
        self._clock, self.max_age_s = node.get_clock(), max_age_s
        self._turned = sleepless_s()
        self._away_s = self._back = 0.0
        self._deaf_until_s = -math.inf
        self._anew_s, self._anew_ns = -math.inf, 0
        self._period_s = min(_WATCH_S, 0.1 * max_age_s)
        steady_timer(node, self._period_s, self._note_turn)

    def begin_anew(self) -> None:
        """Refuse from now on all orders that were sent before: who sent them knew of no stop."""
        self._anew_s, self._anew_ns = sleepless_s(), int(self._clock.now().nanoseconds)

    def _note_turn(self) -> None:
        now, self._deaf_until_s = sleepless_s(), self.deaf_until_s
        late, self._turned = now - self._turned, now
        if late > max(2.0 * self._period_s, self._late_s(now)):
            self._away_s, self._back = late, now

    def _late_s(self, now: float) -> float:
        return self._away_s if now - self._back < min(self._away_s, _DELIVERED_S) else 0.0

    @property
    def away_s(self) -> float:
        """The longest time, s, that an order received now may have waited.

        An absence of the node counts until as much time has passed after it, at most a minute: by
        then all waiting orders have been delivered.
        """
        now = sleepless_s()
        return max(now - self._turned, self._late_s(now))

    @property
    def deaf_until_s(self) -> float:
        """When the last absence ended in which messages may be lost, sleepless s; now in one."""
        now = sleepless_s()
        return now if now - self._turned > _DEAF_S else self._deaf_until_s

    def sent_s(self, stamp: Time, told_s: float | None = None) -> float:
        """Return when (sleepless s) something was sent: at ``told_s``, or at its stamp if earlier.

        Where neither is known, it was sent as long ago as is possible.
        """
        ns, now = stamp_ns(stamp), sleepless_s()
        since = now - self.away_s if told_s is None else told_s
        return min(since, now - 1e-9 * (self._clock.now().nanoseconds - ns)) if ns else since

    def waited_s(self, sent_ns: int) -> float:
        """Return how long (s) a request may have waited, sent at ``sent_ns``, wall clock."""
        told_s = told_age_s(sent_ns, time.time_ns())
        return self.away_s if told_s is None else told_s

    def too_old(self, stamp: Time) -> str:
        """Say why an order with this stamp is too old to be carried out; empty if it is not."""
        ns, since_s = stamp_ns(stamp), sleepless_s() - max(self._anew_s, self.deaf_until_s)
        now_ns = int(self._clock.now().nanoseconds)
        why = describe_untimely(self._clock, ns, self.max_age_s) if ns else ""
        told_s = told_age_s(ns, now_ns)
        untold = told_s is None or self._clock.ros_time_is_active
        if not why and untold and self.away_s > self.max_age_s:
            why = f"may be {self.away_s:.1f} s old, because this node was away for so long"
        if why:
            return f"the order {why}, allowed {self.max_age_s:g} s"
        age_s = max(told_s or 0.0, self.away_s if untold else 0.0)
        # The clock may have been set back since: then a stamp before that lies in the future
        if age_s >= since_s or 0 < ns < self._anew_ns <= now_ns or now_ns < ns < self._anew_ns:
            began = "the arm was stopped, or went on, or this node was away"
            return f"the order was sent before {began}: send it again"
        return ""


PARAMS = (
    Param("order_max_age_s", 2.0, "older trajectories, goals, resets are refused", 0.01, 60.0),
    Param("unstamped", False, "also accept trajectories with the stamp 0 (docs/ros.md)"),
)


class Driver(Protocol):
    """The part of `servo_driver` that `Intake` and `FollowServer` use."""

    @property
    def names(self) -> Sequence[str]: ...
    @property
    def readings(self) -> Mapping[str, ServoReading]: ...
    @property
    def set_points(self) -> Mapping[str, float]: ...
    @property
    def following(self) -> str: ...
    def take(self, message: JointTrajectory, name: str) -> None: ...
    def refuse(self, name: str, why: str) -> None: ...


TWO_DRIVERS = "two drivers publish servo_driver/state: end one of them"
DRIVER_SILENT_S = 3.0
"""A driver whose state was not received for this time, s, is gone. It sends it twice a second."""


class Intake:
    """Receives `joint_trajectory` and `withdrawn`, and passes trajectories to the driver ``site``.

    It also receives `servo_driver/state`: all drivers in a namespace get the same trajectories, so
    none of them may follow one while there is another.
    """

    def __init__(self, node: Node, site: Driver, fresh: Freshness, *, unstamped: bool) -> None:
        self._site, self._unstamped, self._fresh = site, unstamped, fresh
        # Withdrawn ids that are remembered: more than trajectories can wait
        self._withdrawn: deque[str] = deque(maxlen=100)
        self._rival_s = -math.inf  # when another driver was last heard, monotonic s
        graph.DRIVER_STATE.subscription(node, self._on_state)
        graph.WITHDRAWN.subscription(node, self._on_withdrawn)
        # Trajectories that may wait: a later one replaces those before it anyway
        graph.JOINT_TRAJECTORY.subscription(node, self._on_trajectory, depth=10)

    def doubt(self, message: JointTrajectory) -> str:
        """Say why a trajectory must not move the arm: its age, or another driver; empty if it may.

        A trajectory without points, which stops the arm, is never doubted.
        """
        if not message.points:
            return ""
        if time.monotonic() - self._rival_s < DRIVER_SILENT_S:
            return f"{TWO_DRIVERS}; if none is left, try again in {DRIVER_SILENT_S:g} s"
        return self._fresh.too_old(message.header.stamp)

    def _on_state(self, message: DriverState) -> None:
        follows = message.state != DriverState.UNCONFIGURED  # else it has ended, or drives nothing
        if follows and message.instance != THIS_INSTANCE:
            self._rival_s = time.monotonic()

    def _on_trajectory(self, message: JointTrajectory) -> None:
        name = order_id(message)
        if message.points and not (self._unstamped or stamp_ns(message.header.stamp)):
            allowed = "the time of sending, or set unstamped of servo_driver to true"
            self._site.refuse(name, f"header.stamp: 0; allowed: {allowed}")
        elif name in self._withdrawn:
            self._site.refuse(name, "its sender has withdrawn it")
        else:
            self._site.take(message, name)

    def _on_withdrawn(self, message: String) -> None:
        self._withdrawn.append(message.data)
        if message.data and message.data == self._site.following:
            self._site.take(JointTrajectory(), f"{message.data} withdrawn")


class FollowServer:
    """Serves goals of `follow_joint_trajectory`. A new goal replaces the present one."""

    def __init__(self, node: Node, site: Driver) -> None:
        self._node, self._site = node, site
        self._run, self._numbers = uuid.uuid4().hex[:8], itertools.count(1)
        self._told: dict[str, tuple[int, str] | None] = {}
        self._ticks = Ticks(node, 0.05)
        self._server = graph.FOLLOW.server(node, self._serve_goal)

    def on_event(self, event: int, name: str, why: str) -> None:
        """Note an event of `Motion` that the driver publishes about the trajectory ``name``."""
        if name in self._told and event != Motion.ACCEPTED:
            self._told[name] = self._told[name] or (event, why)

    async def _serve_goal(self, goal: Any) -> Any:
        name = f"follow-{self._run}-{next(self._numbers)}"
        try:
            return await self._follow_goal(goal, name)
        finally:
            self._told.pop(name, None)
            self._told.pop(f"{name} halt", None)

    async def _follow_goal(self, goal: Any, name: str) -> Any:
        result, asked = graph.FOLLOW.type.Result, goal.request.trajectory
        problem = _not_offered(goal.request, self._site.names)
        if problem:
            return abort_goal(goal, result.INVALID_GOAL, problem)
        began, deadline_s = self._node.get_clock().now(), math.inf
        tolerance_s = seconds(goal.request.goal_time_tolerance)
        if tolerance_s > 0.0 and asked.points:  # else 0 or -1: none is given
            lasts_s = seconds(asked.points[-1].time_from_start)
            deadline_s = time.monotonic() + lasts_s + tolerance_s
        self._told[name] = None
        self._site.take(asked, name)
        while (end := self._told[name]) is None:
            self._give_feedback(goal, asked.joint_names, began)
            broken = self._find_violation(goal.request.path_tolerance, "on the way")
            late = time.monotonic() > deadline_s
            if broken or late or goal.is_cancel_requested:
                halted = describe_halt(*await self._halt_motion(name))
                if broken:
                    why = f"{broken}: {halted}"
                    return abort_goal(goal, result.PATH_TOLERANCE_VIOLATED, why)
                if late:
                    why = f"not at the end within goal_time_tolerance: {halted}"
                    return abort_goal(goal, result.GOAL_TOLERANCE_VIOLATED, why)
                goal.canceled()
                return result(error_string=f"cancelled: {halted}")
            await self._ticks.next()
        event, why = end
        if event == Motion.REFUSED:
            strange = not set(asked.joint_names) <= set(self._site.names)
            code = result.INVALID_JOINTS if strange else result.INVALID_GOAL
            return abort_goal(goal, code, why)
        if event != Motion.REACHED:
            return abort_goal(goal, result.PATH_TOLERANCE_VIOLATED, why)
        missed = self._find_violation(goal.request.goal_tolerance, "at the end")
        if missed:
            return abort_goal(goal, result.GOAL_TOLERANCE_VIOLATED, missed)
        goal.succeed()
        return result(error_code=result.SUCCESSFUL)

    async def _halt_motion(self, name: str) -> tuple[int, str]:
        """Order a smooth stop; return the event that ends this order, and its reason."""
        halt = f"{name} halt"
        self._told[halt] = None
        self._site.take(JointTrajectory(), halt)
        while (end := self._told[halt]) is None:
            await self._ticks.next()
        return end

    def _find_violation(self, limits: Any, where: str) -> str:
        """Say which joint is farther from its set-point than ``limits`` allow; empty if none."""
        wanted, readings = self._site.set_points, self._site.readings
        for limit in limits:
            if limit.name in wanted and limit.name in readings:
                off = abs(wanted[limit.name] - readings[limit.name].position)
                if 0.0 < limit.position < off:
                    return f"{limit.name} is {off:.4g} off {where}, {limit.position:g} allowed"
        return ""

    def _give_feedback(self, goal: Any, names: Sequence[str], began: Any) -> None:
        wanted, readings = self._site.set_points, self._site.readings
        if not all(name in wanted and name in readings for name in names):
            return
        now = self._node.get_clock().now()
        since = duration(max(0.0, 1e-9 * (now - began).nanoseconds))

        def point(of: Callable[[str], float]) -> JointTrajectoryPoint:
            return JointTrajectoryPoint(positions=[of(n) for n in names], time_from_start=since)

        message = graph.FOLLOW.type.Feedback(joint_names=names)
        message.header.stamp = now.to_msg()
        message.desired = point(lambda name: wanted[name])
        message.actual = point(lambda name: readings[name].position)
        message.actual.velocities = [readings[name].velocity for name in names]
        message.error = point(lambda name: wanted[name] - readings[name].position)
        goal.publish_feedback(message)


def describe_halt(event: int | None, why: str) -> str:
    """Say whether the arm was stopped, from the `Motion` event that ended a stop order.

    ``why``: the reason of an event other than REACHED, or of there being none (None).
    """
    if event == Motion.REACHED:
        return "the arm was stopped"
    return f"the arm was not stopped as asked: {why}"


def abort_goal(goal: Any, code: int, why: str) -> Any:
    """Abort a FollowJointTrajectory goal; return its result with an error code and the reason."""
    goal.abort()
    return graph.FOLLOW.type.Result(error_code=code, error_string=why)


def _not_offered(asked: Any, names: Sequence[str]) -> str:
    """Say which part of a goal a driver of the joints ``names`` does not support; empty if none."""
    if asked.multi_dof_trajectory.points:
        return "multi_dof_trajectory: joints of several degrees of freedom; allowed: none"
    for kind in ("path_tolerance", "goal_tolerance"):
        for limit in getattr(asked, kind):
            if limit.name not in names:
                return f"{kind}: {limit.name!r}; allowed: one of {', '.join(names)}"
            for field in ("position", "velocity", "acceleration"):
                if not math.isfinite(value := getattr(limit, field)):
                    allowed = "a number; 0: not told, -1: none"
                    return f"{kind}: {limit.name}: {field} {value}; allowed: {allowed}"
            if limit.velocity > 0.0 or limit.acceleration > 0.0:
                return f"{kind}: {limit.name}: velocity or acceleration; allowed: position"
    for kind in ("component_path_tolerance", "component_goal_tolerance"):
        if getattr(asked, kind):
            return f"{kind}: of joints of several degrees of freedom; allowed: none"
    return ""
