"""Torque on: the goal that a servo gets then, from readings that may be false."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import pytest
from faulty_bus import FaultyBus

from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import models, open_bus
from longarm_comp.devices.servo_bus.state import IncompleteReply, ServoState

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
