"""Torque on: which servos get it, and their goals, from readings that may be false."""

from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace

import pytest
from driven_arm import MODEL
from faulty_bus import FaultyBus

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.memory import ServoMemory
from longarm_comp.devices.servo_bus.registry import models, open_bus
from longarm_comp.devices.servo_bus.state import IncompleteReply, ServoState
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator

IDS = [1, 2]


@contextmanager
def _bus_that_misreads(
    monkeypatch: pytest.MonkeyPatch, off: dict[int, list[int]]
) -> Iterator[tuple[FaultyBus, SerialServoBus]]:
    """A bus whose n-th readings, by id, are off by so many ticks."""
    servos, at = dict.fromkeys(IDS, models()["sts3215"]), dict.fromkeys(IDS, 2048.0)
    emulator = FaultyBus("feetech", at)
    with emulator, closing(open_bus("feetech", emulator.port, 1_000_000, servos, 0.5, 1)) as bus:
        read, left = bus.read, {i: iter(errors) for i, errors in off.items()}

        def misread(ids: list[int]) -> dict[int, ServoState]:
            return {
                i: replace(state, position_ticks=state.position_ticks + next(left[i], 0))
                for i, state in read(ids).items()
            }

        monkeypatch.setattr(bus, "read", misread)
        yield emulator, bus


@pytest.mark.parametrize("by", [41, -41, 2550])
@pytest.mark.parametrize("first", [0, 1, 2])
def test_a_false_reading_does_not_become_a_goal(
    monkeypatch: pytest.MonkeyPatch, first: int, by: int
) -> None:
    errors = {1: [0] * first + [by], 2: [0, 0, by]}
    with _bus_that_misreads(monkeypatch, errors) as (emulator, bus):
        bus.torque(IDS, on=True)
        assert emulator.each(lambda motor: (motor.goal, motor.torque_on)) == dict.fromkeys(
            IDS, (2048.0, True)
        )


@pytest.mark.parametrize("by", [40, -40])
def test_a_servo_that_creeps_is_switched_on(monkeypatch: pytest.MonkeyPatch, by: int) -> None:
    with _bus_that_misreads(monkeypatch, {1: [0, by], 2: []}) as (emulator, bus):
        bus.torque(IDS, on=True)
        assert emulator.each(lambda motor: motor.goal) == {1: 2048.0 + by, 2: 2048.0}


def test_readings_that_never_agree_switch_nothing_on(monkeypatch: pytest.MonkeyPatch) -> None:
    with _bus_that_misreads(monkeypatch, {1: [], 2: [0, 500] * 9}) as (emulator, bus):
        with pytest.raises(IncompleteReply, match="do not agree") as caught:
            bus.torque(IDS, on=True)
        assert caught.value.facts == {"ids": [2]}
        assert emulator.torques_on() == {1: False, 2: False}


class _Staggered(FaultyBus):
    """A servo and its twin, which answers after it instead of at once."""

    def _answer_frame(self, frame: bytes) -> list[tuple[int, bytes]]:
        replies = ServoEmulator._answer_frame(self, frame)
        others = dict(self._wire.answer(frame, self.twins)) if replies else {}
        return [(i, answer) for i, reply in replies for answer in (reply, others.get(i)) if answer]


def _config(protocol: str, port: str) -> ServoConfig:
    joint = {"model": MODEL[protocol], "type": "revolute", "zero_ticks": 2048.0,
             "lower": -1.0, "upper": 1.0, "max_velocity": 1.0}  # fmt: skip
    line = {"protocol": protocol, "port": port, "reply_timeout_s": 0.5}
    joints = {f"j{i}": {"servo_id": i, **joint} for i in (1, 2, 3)}
    follower = {"silence_s": 1.5}
    return ServoConfig.parse({"bus": line, "joints": joints, "follower": follower}, "here")


@pytest.mark.parametrize("protocol", sorted(MODEL))
@pytest.mark.parametrize("twin", [1, 2, 3])
def test_a_twin_that_answers_in_its_own_time_gets_no_torque(protocol: str, twin: int) -> None:
    emulator = _Staggered(protocol, dict.fromkeys((1, 2, 3), 2048.0))
    with emulator:
        config = _config(protocol, emulator.port)
        with closing(ServoArm(config)) as arm:
            emulator.add_twin(twin, 700.0)
            with pytest.raises(JobError, match="two servos have the same id"):
                arm.power(True)
        with pytest.raises(JobError, match="two servos have the same id"):
            ServoArm(config)
        assert not any(emulator.torques_on().values())
        assert not emulator.twins[twin].motor.torque_on


@pytest.mark.parametrize(("lost", "often"), [(0, 4), (1, 4), (0, 1)])
def test_an_answer_beside_may_be_a_late_one_where_one_was_late_or_once(
    monkeypatch: pytest.MonkeyPatch, lost: int, often: int
) -> None:
    """The late answer to a ping comes while the memory is read, and does not come again."""
    refused, times = not lost and often > 1, iter(range(often))
    emulator = FaultyBus("feetech", dict.fromkeys((1, 2, 3), 2048.0))
    with emulator, closing(ServoArm(_config("feetech", emulator.port))) as arm:
        assert arm.bus is not None
        read, beside = arm.bus.memory, emulator._wire.status(emulator._devices[3], 0, b"1")[1]

        def disturbed(ids: list[int]) -> dict[int, ServoMemory]:
            if next(times, None) is not None:
                emulator.faults.noise, emulator.faults.drops[2] = beside, lost
            return read(ids)

        monkeypatch.setattr(arm.bus, "memory", disturbed)
        with pytest.raises(JobError, match="the same id") if refused else nullcontext():
            arm.power(True)
        assert set(emulator.torques_on().values()) == {not refused}
