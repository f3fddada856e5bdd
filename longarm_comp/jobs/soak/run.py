"""The soak itself: targets at a steady rate, faults at random moments, books at the end."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from trajectory_msgs.msg import JointTrajectory

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.identify.calibrate import declared_model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.dummy_predictor import train_stand_in
from longarm_comp.jobs.path import slow_path
from longarm_comp.jobs.soak.faults import BreakFile, EmergencyStop, Fault, Kill, bad_target
from longarm_comp.jobs.soak.leaks import LeakWatch
from longarm_comp.jobs.soak.ledger import Books
from longarm_comp.jobs.soak.setting import NAMESPACE, Setting
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import running
from longarm_comp.nodes.images import stamp_ns, stamp_of
from longarm_comp.nodes.messages import pose_message
from longarm_comp.nodes.supervisor import Supervisor
from longarm_interfaces.msg import Compensation

_PATH = 2000
_SAMPLE_S = 1.0
_PATIENCE_S = 60.0
_MOST_WAITING = 50
"""Far below the depth of the topics: what is too much for a queue is lost where nobody answers."""
Say = Callable[[str, float], None]


@dataclass
class Scene:
    """The running graph, the stream of targets into it, and what is known of both."""

    setting: Setting
    arm: Arm
    supervisor: Supervisor
    client: ArmClient
    rng: np.random.Generator
    books: Books = field(default_factory=Books)
    leaks: LeakWatch = field(default_factory=LeakWatch)
    expected_deaths: Counter[str] = field(default_factory=Counter)
    struck: Counter[str] = field(default_factory=Counter)
    held_back: int = 0
    _driver: int = 0
    _driver_told: int = 0
    _driver_rose: bool = False
    _driver_at: tuple[int, int] | None = None
    _probing: bool = False
    _probed: int = 0
    _next: float = 0.0
    _sampled: float = 0.0

    def __post_init__(self) -> None:
        """Listen to everything that the books need."""
        node = self.client.node
        self._poses = [pose_message(m) for m in slow_path(self.arm, _PATH)]
        self._target = graph.TARGET_POSE.publisher(node)
        graph.COMPENSATION.subscription(node, self._on_story)
        graph.JOINT_TRAJECTORY.subscription(node, self._on_trajectory)
        graph.DIAGNOSTICS.subscription(node, self._on_diagnostics)

    def _on_story(self, message: Compensation) -> None:
        if self._probing:
            self._probed = stamp_ns(message.target.header.stamp)
            return
        self.books.answer(
            stamp_ns(message.target.header.stamp),
            int(message.status),
            int(message.status) > Compensation.OUT_OF_DOMAIN,
            message.message,
            tuple(message.executed.position),
        )

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if self._probing:
            return
        self.books.trajectory(tuple(message.points[-1].positions))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f"/{NAMESPACE}/servo_driver: arm":
                facts = {pair.key: pair.value for pair in status.values}
                before = self._driver
                self._driver = int(facts["trajectories"]) + int(facts["refused"])
                self._driver_rose = self._driver_rose or self._driver > before
                self._driver_told += 1

    # ------------------------------------------------------------------ the stream

    def ready(self) -> None:
        """Wait until every node does its part, by targets that are in no book.

        A reader that was killed stays matched for a while, so that counting readers says nothing.
        """
        client = self.client
        client.ready(_PATIENCE_S)
        self._probing, self._probed, self._driver_rose = True, 0, False

        def through() -> bool:
            if not (self._probed and self._driver_rose):
                self._publish(good=True)
                client.spin(0.2)
            return bool(self._probed and self._driver_rose)

        client.until(through, _PATIENCE_S, "no target gets through to the servos")
        last = self._publish(good=True)  # answered in their order: then all are
        client.until(lambda: self._probed == last, _PATIENCE_S, "a target has no answer")
        client.spin(1.0)
        self._rested()
        self._probing = False
        self._mark()

    def _rested(self) -> None:
        """The driver's report was made after everything came to rest."""
        told = self._driver_told + 2
        self.client.until(lambda: self._driver_told >= told, _PATIENCE_S, "no /diagnostics")

    def go_on(self, seconds: float) -> None:
        """Targets at the rate for so long."""
        end = time.monotonic() + seconds
        self._next = max(self._next, time.monotonic())
        while (now := time.monotonic()) < end:
            if now >= self._next:
                if self.books.waiting < _MOST_WAITING:
                    self._send(now)
                else:  # the machine does not keep up
                    self.held_back += 1
                self._next += 1.0 / self.setting.rate_hz
            if now - self._sampled > _SAMPLE_S:
                self._sample(now)
            self.client.spin(max(1e-3, min(self._next, end) - time.monotonic()))

    def _send(self, now: float) -> None:
        good = bool(self.rng.random() >= self.setting.bad_share)
        self.books.target(self._publish(good=good), now, good=good)

    def _publish(self, *, good: bool) -> int:
        stamp = int(self.client.node.get_clock().now().nanoseconds)
        made = PoseStamped(pose=self._poses[self.books.sent % _PATH])
        made.header.frame_id, made.header.stamp = "base", stamp_of(stamp)
        self._target.publish(made if good else bad_target(made, self.rng))
        return stamp

    def _sample(self, now: float) -> None:
        self._sampled = now
        for name in self.supervisor.commands:
            self.leaks.sample(name, self.supervisor.pid(name))
        self.leaks.sample("soak", os.getpid())

    # ------------------------------------------------------------------ the books

    def quiet(self) -> None:
        """No target, and every one answered; one that never is goes into the books."""
        end = time.monotonic() + _PATIENCE_S
        self.client.until(
            lambda: not self.books.waiting or time.monotonic() > end, 2 * _PATIENCE_S, "answers"
        )
        self.books.give_up()
        self.client.spin(0.3)

    def audit(self) -> None:
        """Let everything come to rest, and compare what was sent with what the driver got."""
        self.quiet()
        self._rested()
        if self._driver_at is not None:
            sent, got = (
                self.books.trajectories - self._driver_at[0], self._driver - self._driver_at[1],
            )  # fmt: skip
            if sent != got:
                self.books.wrong["trajectory that the driver did not get once"] += abs(sent - got)
        self._mark()

    def _mark(self) -> None:
        self._driver_at = self.books.trajectories, self._driver

    def wait_back(self, node: str, before: int) -> None:
        """A node that was killed is running again and connected; its counters begin anew."""
        back = lambda: self.supervisor.pid(node) != before  # noqa: E731
        self.client.until(back, _PATIENCE_S, f"{node} is away")
        self.ready()


def faults(setting: Setting) -> list[Fault]:
    """Everything that may break, equally often."""
    return [
        Kill("error_predictor"),
        Kill("stereo_bridge"),
        Kill("kinematics", quiet=True),
        Kill("servo_driver", quiet=True),
        BreakFile(setting.model),
        BreakFile(setting.predictor),
        EmergencyStop(),
    ]


def soak(
    setting: Setting, stop: threading.Event, say: Say = lambda text, share: None
) -> dict[str, Any]:
    """Run it; the report as plain data, with ``passed``.

    Raises:
        JobError: the graph did not come up.
        Interrupted: ``stop`` was set.
    """
    setting.out.mkdir(parents=True, exist_ok=True)
    arm = Arm.load(setting.arm)
    save_model(setting.model, store(declared_model(arm)))
    train_stand_in(arm, setting.predictor)
    rng = np.random.default_rng(setting.seed)
    whole = 3600.0 * setting.hours
    begun = time.monotonic()
    with _scene(setting, arm, stop, rng) as scene:
        scene.ready()
        begun = time.monotonic()
        kinds = faults(setting)
        order: list[int] = []
        while (gone := time.monotonic() - begun) < whole:
            say(f"{scene.books.sent} targets, {sum(scene.struck.values())} faults", gone / whole)
            pause = float(rng.exponential(setting.fault_s))
            scene.go_on(min(pause, max(whole - gone, 0.1)))
            if time.monotonic() - begun >= whole:
                break
            order = order or rng.permutation(len(kinds)).tolist()
            fault = kinds[order.pop()]
            scene.struck[fault.name] += 1
            fault.strike(scene)
        scene.audit()
        scene.books.close()
        return _report(scene, time.monotonic() - begun)


@contextmanager
def _scene(
    setting: Setting, arm: Arm, stop: threading.Event, rng: np.random.Generator
) -> Iterator[Scene]:
    os.environ.setdefault("ROS_LOG_DIR", str(setting.out.absolute() / "log"))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with ExitStack() as stack:
        supervisor = stack.enter_context(running(setting.graph()))
        ended = threading.Event()
        watch = threading.Thread(target=supervisor.run, args=(ended,), daemon=True)
        watch.start()
        stack.callback(watch.join, 5.0)
        stack.callback(ended.set)
        client = stack.enter_context(ArmClient(arm, NAMESPACE, stop, "soak"))
        yield Scene(setting, arm, supervisor, client, rng)


def _report(scene: Scene, seconds: float) -> dict[str, Any]:
    books, growth = scene.books, scene.leaks.growth()
    crashes = {
        name: scene.supervisor.deaths(name) - scene.expected_deaths[name]
        for name in scene.supervisor.commands
    }
    crashes = {name: n for name, n in crashes.items() if n > 0}
    return {
        "passed": not books.wrong and not crashes and not any(g.leaks for g in growth),
        "seconds": seconds,
        "targets": books.sent,
        "held_back": scene.held_back,
        "trajectories": books.trajectories,
        "answers_by_status": dict(sorted(books.answered.items())),
        "refusals": dict(books.reasons),
        "faults": dict(scene.struck),
        "wrong": dict(books.wrong),
        "crashes": crashes,
        "growth": [{**vars(g), "leaks": g.leaks} for g in growth],
        "seed": scene.setting.seed,
    }
