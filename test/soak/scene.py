"""The graph under test: sends a stream of targets and enters the answers in the ledger."""

import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.slow_path import slow_path
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.at_work import LEARNED_SAID
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import Supervisor
from longarm_comp.nodes.clock import stamp_ns, stamp_of
from longarm_comp.nodes.messages import duration, pose_message
from longarm_interfaces.msg import Compensation
from soak.clock import SimClock
from soak.leaks import LeakWatch
from soak.ledger import Ledger
from soak.setting import NAMESPACE, SoakSettings

_PATH = 2000
_FAR = 63
"""Targets of the path in half a swing of a joint."""
_NEAR = 0.02  # rad, m
_TRY_S = 3.0
_SAMPLE_S = 1.0
_PATIENCE_S = 300.0
_MOST_WAITING = 50
"""Most open targets. It is far below the depth of the topics, beyond which messages are lost."""


@dataclass
class Scene:
    """The running graph, the stream of targets, and the records of both."""

    setting: SoakSettings
    arm: Arm
    supervisor: Supervisor
    client: ArmClient
    rng: np.random.Generator
    told: list[str]
    """What the supervisor said of starts and ends of processes."""
    ledger: Ledger = field(default_factory=Ledger)
    leaks: LeakWatch = field(default_factory=LeakWatch)
    expected_deaths: Counter[str] = field(default_factory=Counter)
    struck: Counter[str] = field(default_factory=Counter)
    held_back: int = 0
    driver_refusals: int = 0
    """Trajectories that the driver received and refused."""
    resets: Counter[str] = field(default_factory=Counter)
    """Faults of the driver that no fault of the soak explains, by what the driver said."""
    learned_from: int = 0
    """Sightings that the kinematics node learned from, the most in one of its lives."""
    _untold: int | None = None
    _aside: set[int] = field(default_factory=set)
    """Stamps of targets that are not in the ledger: their answers may come late."""
    _refused: int = 0
    _driver: int = 0
    _driver_reports: int = 0
    _driver_rose: bool = False
    _driver_at: tuple[int, int] | None = None
    _probing: bool = False
    _probed: int = 0
    _answer: Compensation | None = None
    _next: float = 0.0
    _sampled: float = 0.0

    def __post_init__(self) -> None:
        """Subscribe to all topics that the ledger needs."""
        node = self.client.node
        self.clock = SimClock(node)
        self._poses = [pose_message(m) for m in slow_path(self.arm, _PATH)]
        self._target = graph.TARGET_POSE.publisher(node)
        graph.COMPENSATION.subscription(node, self._on_compensation)
        graph.JOINT_TRAJECTORY.subscription(node, self._on_trajectory)
        graph.DIAGNOSTICS.subscription(node, self._on_diagnostics)

    def _on_compensation(self, message: Compensation) -> None:
        stamp = stamp_ns(message.target.header.stamp)
        if stamp in self._aside:
            self._probed, self._answer = stamp, message
            return
        self.ledger.answer(
            stamp,
            int(message.status),
            int(message.status) > Compensation.OUT_OF_DOMAIN,
            message.message,
            tuple(message.executed.position),
        )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if self._probing:
            return
        self.ledger.trajectory(tuple(message.points[-1].positions))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            facts = {pair.key: pair.value for pair in status.values}
            if status.name == f"/{NAMESPACE}/kinematics: targets":
                self._untold = int(facts["superseded, not told yet"])
            if status.name == f"/{NAMESPACE}/kinematics: {LEARNED_SAID}":
                self.learned_from = max(self.learned_from, int(facts["sightings"]))
            if status.name == f"/{NAMESPACE}/servo_driver: arm":
                before, refused = self._driver, int(facts["refused"])
                self.driver_refusals += refused - (self._refused if refused >= self._refused else 0)
                self._refused = refused
                self._driver = int(facts["trajectories"]) + refused
                self._driver_rose = self._driver_rose or self._driver > before
                self._driver_reports += 1

    # ------------------------------------------------------------------ the stream

    def ready(self) -> None:
        """Wait until every node works, by sending targets that are not in the ledger.

        Counting subscribers is not enough: a killed one stays matched for a while.
        """
        client = self.client
        client.ready(_PATIENCE_S)
        self._probing, self._probed, self._driver_rose = True, 0, False

        def through() -> bool:
            if not (self._probed and self._driver_rose):
                self._publish(good=True)
                client.spin(0.2)
                self._help()
            return bool(self._probed and self._driver_rose)

        client.until(through, _PATIENCE_S, "no target gets through to the servos")
        last = self._publish(good=True)  # answered in their order: then all are
        client.until(lambda: self._probed == last, _PATIENCE_S, "a target has no answer")
        client.spin(1.0)
        self._rested()
        self._probing = False
        self._mark()

    def recover(self) -> str:
        """Wait until the arm works: a target is answered with status 0, and the joints go there.

        The targets are not in the ledger.

        Returns:
            What did not happen in time; empty if the arm works.
        """
        self.audit()
        self._probing = True
        end = time.monotonic() + self.setting.patience_s
        tries, why = 0, "no target was answered"
        while why and time.monotonic() < end:
            tries += 1
            why = self._try_target(self.ledger.sent + tries * _FAR, why)
        self.client.spin(0.3)
        self._rested()
        self._probing = False
        self._mark()
        return why

    @contextmanager
    def aside(self) -> Iterator[None]:
        """What is sent in here is not in the ledger, and no other target is."""
        self.audit()
        self._probing, self._probed = True, 0
        try:
            yield
        finally:
            self.client.spin(0.3)
            self._rested()
            self._probing = False
            self._mark()

    def flood(self, count: int) -> None:
        """Targets as fast as they can be sent: the last must be answered, the others told of."""
        patience = self.setting.patience_s
        with self.aside():
            last = [self._publish(good=True, number=n) for n in range(count)][-1]
            if not self._within(patience, lambda: self._probed == last):
                self.ledger.wrong["the last target of a flood has no answer"] += 1
            self._untold = None
            if not self._within(patience, lambda: self._untold == 0):
                self.ledger.wrong["a flood is not told of"] += 1

    def path(self, points: int, seconds: float) -> None:
        """A planned path there and back, for `trajectory_compensator`: it must say how it ended."""
        with self.aside():
            server = ActionClient(self.client.node, graph.FOLLOW.type, graph.FOLLOW_PLANNED.name)
            try:
                why = self._path_ends(server, points, seconds)
            finally:
                server.destroy()
        if why:
            self.ledger.wrong[f"a planned path: {why}"] += 1

    def _path_ends(self, server: ActionClient, points: int, seconds: float) -> str:
        patience = self.setting.patience_s
        if not self._within(patience, server.server_is_ready):
            return "nobody takes it"
        arm = self.arm
        share = np.sin(np.linspace(0.0, np.pi, points))[:, None]
        assert self.client.joints is not None
        start = np.clip(self.client.joints, arm.lower, arm.upper)
        joints = start + 0.1 * share * (arm.mid - start)
        goal = graph.FOLLOW.type.Goal()
        goal.trajectory.joint_names = list(arm.joint_names)
        goal.trajectory.header.stamp = stamp_of(self.clock.stamp_ns())
        goal.trajectory.points = [
            JointTrajectoryPoint(positions=q, time_from_start=duration(t))
            for q, t in zip(joints.tolist(), np.linspace(0.1, seconds, points), strict=True)
        ]
        sent = server.send_goal_async(goal)
        if not self._within(patience, sent.done):
            return "no answer to the goal"
        ended = sent.result().get_result_async()
        if not self._within(patience, ended.done):
            return "it never ends"
        done = ended.result()
        followed = done.status == GoalStatus.STATUS_SUCCEEDED
        return "" if followed or done.result.error_string else "refused without a reason"

    def _try_target(self, number: int, why: str) -> str:
        """Send one target: why it was not reached (``why`` if it had no answer), or nothing."""
        self._answer, before = None, self.client.joints
        stamp = self._publish(good=True, number=number)
        if not self._within(_TRY_S, lambda: self._probed == stamp) or self._answer is None:
            return why
        if self._answer.status != Compensation.SUCCESS:
            why = f"status {self._answer.status}: {self._answer.message}"
            self._help()
            self.client.spin(0.1)
            return why
        goal = np.array(self._answer.executed.position)

        def there() -> bool:
            at = self.client.joints
            return at is not None and bool(np.abs(at - goal).max() < _NEAR)

        if not self._within(_TRY_S, there):
            return "a command was sent and the joints did not go there"
        if before is not None and np.abs(goal - before).max() < 2 * _NEAR:
            return "the joints were there before"
        return ""

    def _help(self) -> None:
        """Reset the driver if the last answer says that it needs it."""
        said, self._answer = self._answer, None
        if said and said.status == Compensation.NO_DRIVER and "reset" in said.message:
            self.resets[re.split(r"-?[\[\d]", said.message)[0].strip()] += 1
            self.reset()

    def reset(self) -> None:
        """Reset the driver, as a person would whose servos answer again."""
        reset = graph.RESET.client(self.client.node, of="servo_driver")
        self.client.until(
            lambda: self.client.call(reset, Trigger.Request(), again=True).success,
            self.setting.patience_s, "the driver's fault cannot be reset",
        )  # fmt: skip
        self.client.node.destroy_client(reset)

    def _within(self, seconds: float, condition: Callable[[], bool]) -> bool:
        """Spin until a condition holds, or for so many seconds; whether it holds."""
        end = time.monotonic() + seconds
        self.client.until(
            lambda: condition() or time.monotonic() > end, seconds + _PATIENCE_S, "the graph"
        )
        return condition()

    def _rested(self) -> None:
        """Wait for a report of the driver from after everything came to rest."""
        wanted = self._driver_reports + 2
        self.client.until(lambda: self._driver_reports >= wanted, _PATIENCE_S, "no /diagnostics")

    def go_on(self, seconds: float) -> None:
        """Send targets at the rate for a number of seconds."""
        end = time.monotonic() + seconds
        self._next = max(self._next, time.monotonic())
        while (now := time.monotonic()) < end:
            if now >= self._next:
                if self.ledger.waiting < _MOST_WAITING:
                    self._send(now)
                else:  # the machine does not keep up
                    self.held_back += 1
                self._next += 1.0 / self.setting.rate_hz
            if now - self._sampled > _SAMPLE_S:
                self._sample(now)
            self.client.spin(max(1e-3, min(self._next, end) - time.monotonic()))

    def _send(self, now: float) -> None:
        good = bool(self.rng.random() >= self.setting.bad_share)
        self.ledger.target(self._publish(good=good), now, good=good)

    def _publish(self, *, good: bool, number: int | None = None) -> int:
        stamp = self.clock.stamp_ns()
        if self._probing:
            self._aside.add(stamp)
        place = self.ledger.sent if number is None else number
        message = PoseStamped(pose=self._poses[place % _PATH])
        message.header.frame_id, message.header.stamp = "base", stamp_of(stamp)
        self._target.publish(message if good else bad_target(message, self.rng))
        return stamp

    def _sample(self, now: float) -> None:
        self._sampled = now
        for name in self.supervisor.commands:
            self.leaks.sample(name, self.supervisor.pid(name))
        self.leaks.sample("soak", os.getpid())

    # ------------------------------------------------------------------ the ledger

    def quiet(self) -> None:
        """Wait until every target is answered; enter those that are not as lost."""
        end = time.monotonic() + _PATIENCE_S
        self.client.until(
            lambda: not self.ledger.waiting or time.monotonic() > end, 2 * _PATIENCE_S, "answers"
        )
        self.ledger.give_up()
        self.client.spin(0.3)

    def audit(self) -> None:
        """Wait for rest, then compare the trajectories sent and received by the driver."""
        self.quiet()
        self._rested()
        if self._driver_at is not None:
            sent, got = (
                self.ledger.trajectories - self._driver_at[0], self._driver - self._driver_at[1],
            )  # fmt: skip
            if sent != got:
                self.ledger.wrong["trajectory that the driver did not get once"] += abs(sent - got)
        self._mark()

    def _mark(self) -> None:
        self._driver_at = self.ledger.trajectories, self._driver

    def wait_back(self, node: str, before: int) -> None:
        """Wait until a killed node runs again and is connected. Its counters restart at 0."""
        back = lambda: self.supervisor.pid(node) != before  # noqa: E731
        self.client.until(back, _PATIENCE_S, f"{node} is away")
        self.ready()


def bad_target(good: PoseStamped, rng: np.random.Generator) -> PoseStamped:
    """A target that must be refused, with one of five faults."""
    message = PoseStamped(header=good.header)
    message.pose.position.x = good.pose.position.x
    message.pose.position.y = good.pose.position.y
    message.pose.position.z = good.pose.position.z
    message.pose.orientation.w = 1.0
    ways = (
        lambda: setattr(message.pose.position, "x", float("nan")),
        lambda: setattr(message.pose.position, "z", float("inf")),
        lambda: setattr(message.header, "frame_id", "kitchen"),
        lambda: setattr(message.pose.orientation, "w", 2.0),
        lambda: setattr(message.pose.position, "y", message.pose.position.y + 30.0),
    )
    ways[int(rng.integers(len(ways)))]()
    return message
