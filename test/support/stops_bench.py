"""The driver's stops without the rest of it: real services and files, emulated servos."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from faulty_bus import FaultyBus
from nodes_bench import Bench
from std_srvs.srv import SetBool, Trigger

from longarm_comp.devices.follower_report import FollowerState
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_arm import Cycle, ServoArm
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.orders import Freshness
from longarm_comp.nodes.stops import Stops
from longarm_interfaces.msg import DriverState

JOINT = {
    "model": "sts3215", "type": "revolute", "zero_ticks": 2048.0, "gear_ratio": 10.0,
    "multi_turn": True, "lower": 0.0, "upper": 0.5, "max_velocity": 0.4,
}  # fmt: skip
MAX_AGE_S = 5.0


class StoppedArm:
    """What `Stops` sees of a driver, active from the start, and clients of its services."""

    def __init__(self, stage: Bench, folder: Path, emulator: FaultyBus) -> None:
        self.stage, self.emulator, self.active = stage, emulator, True
        self.state = (DriverState.READY, "")
        self.told: list[tuple[bool, tuple[int, str]]] = []
        line = {"protocol": "feetech", "port": emulator.port, "reply_timeout_s": 0.25, "retries": 1}
        joints = {"a": {"servo_id": 1, **JOINT}, "b": {"servo_id": 2, **JOINT}}
        follower = {"silence_s": 5.0, "stall_time_s": 5.0}
        text = {"bus": line, "joints": joints, "follower": follower}
        self.config = ServoConfig.parse(text, "here")
        self.arm: ServoArm | None = None
        self.fresh = Freshness(stage.node, MAX_AGE_S)
        self.stops = Stops(stage.node, self, str(folder), "", self.config, self.fresh)
        services = (graph.ESTOP, graph.HOLD, graph.RESET)
        self._clients = {name: name.client(stage.node, of="tester") for name in services}
        for client in self._clients.values():
            stage.spin(client.service_is_ready)

    def tell_state(self) -> None:
        self.told.append((bool(self.stops.standing), self.stops.state))

    def configure(self) -> None:
        """As the driver does, and activates."""
        self.arm = ServoArm(self.config, stopped=self.stops.estop or bool(self.stops.owed))
        self.stops.owe_off(False)
        self.stops.let_go()
        if not self.stops.standing:
            self.arm.power(True)
        self.cycles()

    def cycles(self, until: Any = None) -> list[Cycle]:
        """Drive until something is truthy, ten times without it; what came of it."""
        done: list[Cycle] = []
        assert self.arm is not None
        for _ in range(2000):
            done.append(self.arm.cycle(time.monotonic()))
            if until() if until is not None else len(done) == 10:
                return done
            time.sleep(0.01)
        raise AssertionError("not within 2000 cycles")

    def moves(self) -> None:
        """On its way."""
        assert self.arm is not None
        way = JointTrajectory(("a",), (TrajectoryPoint(0.0, (0.4,)),))
        self.arm.accept(way, time.monotonic())
        self.cycles()

    def in_fault(self) -> None:
        """Servo 1 was too hot for a moment."""
        assert self.arm is not None
        follower = self.arm.follower
        for celsius in (68.0, 30.0):
            with self.emulator.motor(1) as motor:
                motor.temperature_c = celsius
            self.cycles(lambda: follower.state is FollowerState.FAULT)
        self.cycles()

    def send(self, service: graph.Service, data: bool | None = None) -> Any:
        """Send a request, and do not wait; its future."""
        asked = Trigger.Request() if data is None else SetBool.Request(data=data)
        return self._clients[service].call_async(asked)

    def answers(self, *asked: Any) -> list[Any]:
        """The answers to requests."""
        self.stage.spin(lambda: all(one.done() for one in asked))
        return [one.result() for one in asked]

    def ask(self, service: graph.Service, data: bool | None = None) -> Any:
        """The answer to a request; asked again while a stop still has to stand."""
        return self.stage.until_heard(lambda: self.answers(self.send(service, data))[0])

    @property
    def on(self) -> set[bool]:
        """Whether servos are driven."""
        return set(self.emulator.torques_on().values())


@contextmanager
def stopped_arm(stage: Bench, folder: Path) -> Iterator[StoppedArm]:
    emulator = FaultyBus("feetech", {1: 3000.0, 2: 3000.0})
    with emulator:
        made = StoppedArm(stage, folder, emulator)
        try:
            yield made
        finally:
            if made.arm is not None:
                made.arm.close()
