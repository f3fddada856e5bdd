"""A `ServoArm` of two joints whose torque is on, on emulated servos with faults."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from faulty_bus import FaultyBus

from longarm_comp.devices.follower_report import FollowerState
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_arm import Cycle, ServoArm
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_watch import ServoTrouble
from longarm_comp.sim.servo_emulator.joints import EmulatedArm, read_arm
from longarm_comp.sim.servo_emulator.motor import MotorSpec

CONFIG = """
bus: {protocol: %s, port: %s, reply_timeout_s: 0.1, retries: 1}
joints:
  shoulder: {servo_id: 1, model: %s, type: revolute, zero_ticks: 2048, gear_ratio: 3.0,
             multi_turn: true, lower: -0.5, upper: 1.0, max_velocity: 1.0}
  boom: {servo_id: 2, model: %s, %s}
follower: {stall_time_s: 0.6, silence_s: 1.5}
"""
RACK = (
    "type: prismatic, zero_ticks: 3900, direction: -1, pinion_radius_m: 0.018, lower: 0.0, "
    "upper: 0.1, max_velocity: 0.09"
)
HORN = "type: revolute, zero_ticks: 2048, lower: -1.0, upper: 1.0, max_velocity: 0.9"
"""The boom of a rack, and one on its servo's horn."""
MODEL = {"feetech": "sts3215", "dynamixel": "xl430-w250"}


class Driven:
    """A `ServoArm` whose torque is on, with its emulator."""

    def __init__(self, config: ServoConfig, emulator: FaultyBus, true: EmulatedArm) -> None:
        self.config, self.emulator, self._true = config, emulator, true
        self.arm = ServoArm(config)
        self.troubles: list[tuple[ServoTrouble, str]] = []
        self.arm.power(True)

    def until(self, done: Callable[[Cycle], object], limit_s: float = 180.0) -> None:
        """Cycle until ``done``; the limit is only there to end a broken test."""
        end = time.monotonic() + limit_s
        while True:
            cycle = self.arm.cycle(time.monotonic())
            findings = [event.finding for event in cycle.step.events if event.finding is not None]
            self.troubles += [(f.trouble, f.joint) for f in findings]
            if done(cycle):
                return
            assert time.monotonic() < end
            time.sleep(0.005)

    def becomes(self, state: FollowerState) -> None:
        self.until(lambda cycle: cycle.step.state is state)

    def send(self, **target: float) -> None:
        self.until(lambda cycle: cycle.joints)
        point = TrajectoryPoint(0.0, tuple(target.values()))
        self.arm.accept(JointTrajectory(tuple(target), (point,)), time.monotonic())

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.until(lambda _: True)

    def joints(self) -> dict[str, float]:
        """Where the arm really is: the emulator's own conversion."""
        return self._true.values(self.emulator.positions())

    def stands(self, **at: float) -> None:
        """Cycle until the arm really is there, within a tick."""
        self.until(lambda _: all(abs(self.joints()[n] - v) < 6e-4 for n, v in at.items()))

    def turn_by_hand(self, ticks: float) -> None:
        """Turn the shoulder where nothing holds it."""
        self.emulator.push(1, self.emulator.positions()[1] + ticks)


@contextmanager
def driven_arm(protocol: str, folder: Path, boom: str = RACK) -> Iterator[Driven]:
    model, link = MODEL[protocol], folder / "bus"
    path = folder / "servo_driver.yaml"
    path.write_text(CONFIG % (protocol, link, model, model, boom))
    true = read_arm(path)
    at = {"shoulder": 0.2, "boom": 0.02}
    start = {joint.servo_id: joint.ticks(at[joint.name]) for joint in true.joints}
    emulator = FaultyBus(protocol, start, MotorSpec(max_speed_ticks_s=6000), link)
    with emulator:
        made = Driven(ServoConfig.load(path), emulator, true)
        try:
            yield made
        finally:
            made.arm.close()
