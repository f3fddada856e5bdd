"""`servo_driver` as a process, on an emulated bus that a test holds in its hands."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from builtin_interfaces.msg import Duration, Time
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nodes_bench import Bench, bench, facts_of, last_status
from own_graph import own_graph
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.devices.state_folder import state_folder
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.orders import Stamps, order_id
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import MotorSpec
from longarm_interfaces.msg import DriverState, Motion

CONFIG = """
/**/servo_driver:
  ros__parameters:
    retry_s: 0.2
    diagnostics_period_s: 0.1
    bus: {protocol: feetech, port: PORT, reply_timeout_s: 0.2, retries: 1}
    joints:
      shoulder: {servo_id: 1, model: sts3215, type: revolute, zero_ticks: 2048.0, gear_ratio: 3.0,
        multi_turn: true, lower: -0.5, upper: 1.0, max_velocity: 1.7,
        full_effort: 8.0}
      boom: {servo_id: 2, model: sts3215, type: prismatic, zero_ticks: 3900.0, direction: -1,
        pinion_radius_m: 0.018, lower: 0.0, upper: 0.1, max_velocity: 0.09}
    follower: {stall_time_s: 0.3, silence_s: 1.0}
"""


class Rig:
    """An emulated bus, the driver's process, and what it says."""

    def __init__(self, stage: Bench, folder: Path) -> None:
        self.stage = stage
        self.file = folder / "servo_driver.yaml"
        self.link = folder / "bus"
        self.file.write_text(CONFIG.replace("PORT", str(self.link)))
        self.arm = read_arm(self.file)
        self.emulator = ServoEmulator(
            self.arm.protocol, self.arm.start_ticks(), MotorSpec(stiff_ticks=30.0), link=self.link
        )
        self.emulator.start()
        self.states = stage.collect(graph.JOINT_STATES)
        self.motions = stage.collect(graph.MOTION)
        self.said = stage.collect(graph.DRIVER_STATE)
        self.diagnostics = stage.collect(graph.DIAGNOSTICS)
        self.trajectories = graph.JOINT_TRAJECTORY.publisher(stage.node)
        self.stamps, self.ids = Stamps(stage.node.get_clock()), dict[str, list[str]]()
        self.dead: set[tuple[int, ...]] = set()
        self.process = self.start()

    def start(self, **params: object) -> subprocess.Popen[str]:
        """Start a driver; what another one said before is forgotten."""
        command = ["-m", "longarm_comp.nodes.servo_driver", "--ros-args"]
        command += ["--params-file", str(self.file)]
        for name, value in params.items():
            command += ["-p", f"{name}:={value}"]
        del self.states[:], self.said[:], self.diagnostics[:]
        self.process = self.stage.python(command)
        return self.process

    def ends(self) -> None:
        """End the driver."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(timeout=300) == 0
        self.stage.spin(lambda: not self.hears())

    def keeps_a_fault(self) -> None:
        """Wait until the fault that the driver told is kept, with its words: they come later."""

        def texts() -> list[str]:
            return [file.read_text() for file in state_folder().glob("*.fault")]

        self.stage.spin(lambda: texts() and all(texts()))

    def dies(self) -> None:
        """Kill the driver."""
        self.dead |= self._listed()
        self.process.kill()
        self.process.wait(timeout=300)

    def hears(self) -> bool:
        """Whether a driver hears trajectories; one that was killed is listed for 20 s more."""
        dead = len(self.dead & self._listed())
        return bool(self.trajectories.get_subscription_count() > dead)

    def _listed(self) -> set[tuple[int, ...]]:
        node, topic = self.stage.node, self.trajectories.topic_name
        return {tuple(told.endpoint_gid) for told in node.get_subscriptions_info_by_topic(topic)}

    def begins_without_servos(self, patience_s: float) -> subprocess.Popen[str]:
        """End the driver and start it anew with no cable."""
        self.ends()
        self.emulator.unplug()
        return self.start(patience_s=patience_s)

    def killed(self) -> None:
        """Kill the driver and start another one."""
        self.dies()
        self.start()

    def anew(self) -> Rig:
        """A new driver that nobody has stopped, ready; the servos are as they were made."""
        if self.process.poll() is None:
            self.stage.spin(lambda: self.said)  # from then on it hears a signal
            self.process.send_signal(signal.SIGINT)
            assert self.process.wait(timeout=300) == 0
        self.emulator.unplug()
        shutil.rmtree(state_folder(), ignore_errors=True)
        with self.emulator.motor(1) as motor:
            motor.blocked = False
        self.emulator.start()
        self.start()
        self.in_order().is_in(DriverState.READY)
        self.goes(shoulder=0.2)  # so it hears trajectories
        return self

    def driving(self) -> bool:
        return all(self.emulator.torques_on().values())

    def free(self) -> bool:
        return not any(self.emulator.torques_on().values())

    def joints(self) -> dict[str, float]:
        """Where the emulated joints really stand."""
        return self.arm.values(self.emulator.positions())

    def rests(self) -> dict[str, float]:
        """The same, once they no longer creep towards where they were sent, in ten readings."""
        stood: dict[str, float] = {}
        read = len(self.states)

        def still() -> bool:
            nonlocal read
            if len(self.states) < read + 10:
                return False
            before, read = dict(stood), len(self.states)
            stood.update(self.joints())
            return before == pytest.approx(stood, abs=1e-7)

        self.stage.spin(still)
        return stood

    def stands_still(self) -> dict[str, float]:
        """The same by the joints alone, where no driver reads them: in a quarter of a second."""
        stood, looked = self.joints(), time.monotonic()

        def still() -> bool:
            nonlocal stood, looked
            if time.monotonic() < looked + 0.25:
                return False
            before, stood, looked = stood, self.joints(), time.monotonic()
            return before == pytest.approx(stood, abs=1e-7)

        self.stage.spin(still)
        return stood

    def send(
        self, name: str = "", stamp: Time | None = None, lasts_s: int = 0, **goal: float
    ) -> str:
        """Send a trajectory that this test calls so; the id by which the driver tells of it."""
        lasts = Duration(sec=lasts_s, nanosec=200_000_000)
        point = JointTrajectoryPoint(positions=list(goal.values()), time_from_start=lasts)
        self.stage.spin(self.hears)
        sent = JointTrajectory(joint_names=list(goal), points=[point])
        sent.header.stamp = self.stamps.next() if stamp is None else stamp
        self.ids.setdefault(name, []).append(order_id(sent))
        self.trajectories.publish(sent)
        return order_id(sent)

    def told_of(self, name: str) -> list[Motion]:
        """What the driver has told of the trajectories of that name, or of that id."""
        return [motion for motion in self.motions if motion.id in self.ids.get(name, [name])]

    def events(self, name: str) -> list[int]:
        """The same, as events."""
        return [motion.event for motion in self.told_of(name)]

    def becomes(self, name: str, *events: int) -> Motion:
        """Wait until this, and nothing else, has become of a trajectory; the last message."""
        self.stage.spin(lambda: len(self.events(name)) >= len(events))
        assert self.events(name) == list(events), self.told_of(name)
        return self.told_of(name)[-1]

    def is_in(self, state: int) -> DriverState:
        """Wait until the driver tells that state."""
        self.stage.spin(lambda: self.said and self.said[-1].state == state)
        return self.said[-1]

    def stands(self, **goal: float) -> bool:
        """Whether the emulated joints stand there."""
        at = self.joints()
        return all(abs(at[name] - value) < 1e-3 for name, value in goal.items())

    def arrives(self, **goal: float) -> None:
        self.stage.spin(lambda: self.stands(**goal))

    def goes(self, stamp: Time | None = None, **goal: float) -> None:
        """Send until the driver takes it and goes there: its subscription may still be connecting,
        and on a busy machine an order may be old when it is read, a servo silent, or the driver
        itself away."""
        for _ in range(6):
            sent = self.send(stamp=stamp, **goal)
            with contextlib.suppress(AssertionError):
                self.stage.spin(lambda sent=sent: self.events(sent), within=5.0)
            if Motion.ACCEPTED in self.events(sent):
                self.stage.spin(
                    lambda sent=sent: Motion.BROKEN_OFF in self.events(sent) or self.stands(**goal)
                )
                if self.stands(**goal):
                    return
        self.arrives(**goal)

    def refuses(self, word: str) -> None:
        """Send trajectories until the driver, whose subscription may be connecting, refuses one."""
        sent: list[str] = []

        def refused() -> bool:
            told = [motion for name in sent for motion in self.told_of(name)]
            assert all(motion.event == Motion.REFUSED for motion in told)
            return bool(told) and all(word in motion.message for motion in told)

        for _ in range(300):
            sent.append(self.send(shoulder=0.25))
            with contextlib.suppress(AssertionError):
                self.stage.spin(refused, within=1.0)
                return
        raise AssertionError(f"nothing was refused for {word}\n{self.stage.state()}")

    def told(self, part: str) -> str:
        """The last sentence of a part of /diagnostics."""
        status = last_status(self.diagnostics, part)
        return "" if status is None else str(status.message)

    def refused(self) -> int:
        """How many trajectories it says it refused; -1 where it has told nothing yet."""
        told = (facts_of(status) for array in reversed(self.diagnostics) for status in array.status)
        return next((int(facts["refused"]) for facts in told if "refused" in facts), -1)

    def call(self, service: graph.Service, request: Any) -> Any:
        """Ask the driver; again where a stop still stands, or that was old when it was served."""
        client = service.client(self.stage.node, of="servo_driver")
        return self.stage.until_heard(lambda: self.stage.call(client, request))

    def change(self, transition: int) -> bool:
        """Ask for a transition; whether it was made.

        Where an answer is lost the bench asks again, and then there is nothing left to change.
        """
        client = self.stage.node.create_client(ChangeState, "servo_driver/change_state")
        request = ChangeState.Request(transition=Transition(id=transition))
        made = bool(self.stage.call(client, request).success)
        return made or self.stage.asked[client] > 1

    def is_idle(self) -> None:
        """Wait until it drives and has read every servo."""
        self.stage.spin(lambda: self.driving() and self.told(": arm") in ("idle", "holding"))

    def in_order(self) -> Rig:
        """Forget what was said; running, and started again where a test ended it."""
        del self.diagnostics[:], self.motions[:]
        self.ids.clear()
        if self.process.poll() is not None:
            self.start()
        self.is_idle()
        return self


@contextmanager
def driver_rig(folder: Path) -> Iterator[Rig]:
    """A driver on a graph of its own."""
    with own_graph(folder, freezes=True), bench() as stage:
        made = Rig(stage, folder)
        try:
            yield made
        finally:
            stage.end_processes()
            made.emulator.unplug()
