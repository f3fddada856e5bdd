"""Orders that move joints: their stamp and id, their age, and which ones a driver carries out."""

from __future__ import annotations

import hashlib
import time
from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from builtin_interfaces.msg import Time
from rclpy.clock import Clock
from rclpy.node import Node
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.devices.servo_arm import ServoReading
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.params import Param
from longarm_comp.nodes.stamps import stamp_ns, stamp_of
from longarm_comp.nodes.ticks import steady_timer


def order_id(message: JointTrajectory) -> str:
    """Id of a trajectory, the same for its sender and for whoever receives it."""
    content = hashlib.blake2s("\n".join(message.joint_names).encode(), digest_size=6)
    for point in message.points:
        after = point.time_from_start
        content.update(array("q", [after.sec, after.nanosec]).tobytes())
        for values in (point.positions, point.velocities, point.accelerations):
            content.update(array("d", values).tobytes() + b"|")
    return f"{stamp_ns(message.header.stamp)}-{content.hexdigest()}"


class Stamps:
    """Stamps of a node's orders: now; while its clock stands, each 1 ns later than the one before.

    A clock that goes back takes them with it.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock, self._read, self._last = clock, 0, 0

    def next(self) -> Time:
        before, self._read = self._read, int(self._clock.now().nanoseconds)
        stood = before <= self._read <= self._last
        self._last = self._last + 1 if stood else self._read
        return stamp_of(self._last)


def untimely(clock: Clock, stamp: int, max_age_s: float) -> str:
    """Why a message of that stamp (ns) is too old, or of the future; empty if it is not."""
    age = 1e-9 * (clock.now().nanoseconds - stamp)
    if abs(age) <= max_age_s:
        return ""
    return f"is {age:.1f} s old" if age > 0 else f"lies {-age:.1f} s in the future"


class Freshness:
    """How old an order may be that a node takes now.

    A stamp tells it, on a clock that runs. Without one it waited at most for as long as the node
    was away, stopped or overloaded: a timer on the node's executor watches that.
    """

    def __init__(self, node: Node, max_age_s: float) -> None:
        self._clock, self.max_age_s = node.get_clock(), max_age_s
        self._turned = time.monotonic()
        self._away_s = self._back = 0.0
        # Period of the watch, as a share of the age allowed
        steady_timer(node, 0.1 * max_age_s, self._turn)

    def _turn(self) -> None:
        late = time.monotonic() - self._turned
        self._turned += late
        if late > self.max_age_s:
            self._away_s, self._back = late, self._turned

    @property
    def away_s(self) -> float:
        """What is taken now may have waited for so long, s.

        What came meanwhile may be delivered late too. It is worked off in no longer than it came
        in, so it counts for as long as the node was away.
        """
        now = time.monotonic()
        late = self._away_s if now - self._back < self._away_s else 0.0
        return max(now - self._turned, late)

    def too_old(self, stamp: Time) -> str:
        """Why an order is too old to be carried out, in words; empty if it is not."""
        ns = stamp_ns(stamp)
        why = untimely(self._clock, ns, self.max_age_s) if ns else ""
        if not why and (not ns or self._clock.ros_time_is_active) and self.away_s > self.max_age_s:
            why = f"may be {self.away_s:.1f} s old, because this node was away for so long"
        return f"the order {why}, allowed {self.max_age_s:g} s" if why else ""


PARAMS = (
    Param("order_max_age_s", 2.0, "trajectories and goals older than this are refused", 0.01, 60.0),
    Param("unstamped", False, "also accept trajectories with the stamp 0 (docs/ros.md)"),
)


_NO_STAMP = (
    "header.stamp: 0; allowed: the time of sending, or set unstamped of servo_driver to true"
)


class Driver(Protocol):
    """What decides of a trajectory needs of the driver: as `servo_driver` has it."""

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


class Intake:
    """Hears `joint_trajectory` and `withdrawn`."""

    def __init__(self, node: Node, site: Driver, max_age_s: float, *, unstamped: bool) -> None:
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
