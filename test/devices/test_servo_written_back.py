"""Nudges of a setup, and what it changed in servos: written back, whatever happens."""

import contextlib
import errno
import io
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from cli_shell import Shell
from servo_bench import (
    MODELS,
    POSE_FLAGS,
    configured,
    direct,
    folder,
    limit,
    refuses,
    store,
    stored,
    two,
)
from servo_bench import bus as geared_bus
from servo_terminal import RIGHT

from longarm_comp.core.errors import JobError
from longarm_comp.devices import servo_setup
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import models, open_bus
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_setup import ServoSetup
from longarm_comp.devices.setup_journal import SetupJournal
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import Stop, StopLatch
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.motor import Motor
from longarm_comp.sim.servo_emulator.wire import Device

pytestmark = pytest.mark.usefixtures("nobody_there")


def a_setup(bus: SerialServoBus, config: ServoConfig, *check: Callable[[], object]) -> ServoSetup:
    return ServoSetup(bus, config.joints, SetupJournal("", "mine/arm.yaml", bus), *check)


# ---- the nudge ----------------------------------------------------------------------------------


@contextmanager
def bench(emulator: ServoEmulator, config: ServoConfig) -> Iterator[ServoSetup]:
    with closing(config.open_bus()) as bus, a_setup(bus, config).safely() as made:
        made.rest()
        made.hold()
        yield made


def test_a_nudge_is_slow_also_where_the_speed_is_taken_for_something_else(
    shell: Shell, emulator: ServoEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The goals creep: no more than a tenth of a second's way at once."""
    mine = direct(shell, MODELS[emulator.protocol])
    monkeypatch.setattr(Motor, "speed_limit", property(lambda m: 0.0, lambda m, v: None), False)
    sent: list[int] = []
    write = SerialServoBus.write_goal

    def noted(bus: SerialServoBus, goals: dict[int, int], speeds: object = None) -> None:
        sent.extend(goals.values() if len(goals) == 1 else ())
        time.sleep(0.3 * (len(sent) == 5))  # the computer had something else to do
        write(bus, goals, speeds)

    monkeypatch.setattr(SerialServoBus, "write_goal", noted)
    with bench(emulator, configured(mine, emulator)) as made, made.nudge("joint2") as grew:
        assert grew == 1
        assert emulator.positions()[2] == pytest.approx(2048 + 57, abs=6.5)
    assert (sent[0] - 2048, max(sent)) == (0, 2048 + 57)
    assert max(abs(b - a) for a, b in itertools.pairwise(sent)) <= 7
    assert emulator.positions()[2] == pytest.approx(2048, abs=6.5)


@pytest.mark.parametrize("before", ["the torque", "the nudge", "the way back"])
def test_a_stop_that_comes_during_a_setup_is_heeded_before_the_next_motion(
    shell: Shell, emulator: ServoEmulator, before: str
) -> None:
    config = configured(direct(shell, MODELS[emulator.protocol]), emulator)
    stops: list[str] = []

    def check() -> None:
        if stops:
            raise JobError(stops[0])

    with (
        closing(config.open_bus()) as bus,
        a_setup(bus, config, check).safely() as made,
        pytest.raises(JobError, match="stopped meanwhile"),
    ):
        if before == "the torque":
            stops.append("stopped meanwhile")
        made.hold()
        assert before != "the torque"
        if before == "the nudge":
            stops.append("stopped meanwhile")
        with made.nudge("joint2"):
            assert before == "the way back"
            stops.append("stopped meanwhile")
    assert not any(emulator.torques_on().values())
    moved = 57 if before == "the way back" else 0
    assert emulator.positions()[2] == pytest.approx(2048 + moved, abs=6.5)


def test_the_command_looks_for_stops_again_before_it_holds_the_arm(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminals(io.StringIO):
        def isatty(self) -> bool:
            return True

    mine, rest = folder(shell, "sts3215"), ServoSetup.rest
    with geared_bus("feetech") as emulator:

        def stopped(setup: ServoSetup) -> dict[str, float]:
            latch = StopLatch(state_folder(), "/", "", emulator.port)
            latch.ask(Stop.HOLD)
            latch.keep()
            return rest(setup)

        monkeypatch.setattr(ServoSetup, "rest", stopped)
        monkeypatch.setattr(sys, "stdin", Terminals())
        words = ("--port", emulator.port, "--yes", "--ids", "1-3", *POSE_FLAGS)
        said = shell.refused("servo", "setup", mine, *words, code=3)
        assert "nothing is moved: held since" in said
        assert not any(emulator.torques_on().values())


@pytest.mark.parametrize("goes", ["away", "on"])
def test_a_servo_that_is_not_where_it_is_led_is_let_go(
    shell: Shell, emulator: ServoEmulator, monkeypatch: pytest.MonkeyPatch, goes: str
) -> None:
    """It turns the other way round, or on and on, whatever its registers say."""
    mine = direct(shell, MODELS[emulator.protocol])
    wire, write = emulator._wire, type(emulator._wire).write

    def wrong(wire: object, device: Device, address: int, data: bytes) -> int:
        code = write(wire, device, address, data)
        motor = device.motor
        if motor.torque_on and round(motor.goal) not in (2048, 2500):
            motor.goal = 2500.0 if goes == "on" else 2048 - 5 * (motor.goal - 2048)
        return code

    monkeypatch.setattr(type(wire), "write", wrong)
    words = "servo 2 of joint2 does not move as slowly as asked"
    with bench(emulator, configured(mine, emulator)) as made:
        with pytest.raises(JobError, match=words), made.nudge("joint2"):
            raise AssertionError
        assert emulator.torques_on() == {1: True, 2: False}
    assert not any(emulator.torques_on().values())
    assert abs(emulator.positions()[2] - 2048) < 450


def test_a_nudge_stays_within_the_servos_limits_or_names_them(
    shell: Shell, emulator: ServoEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = direct(shell, MODELS[emulator.protocol])
    limit(emulator, 2, 1500, 2050)
    config = configured(mine, emulator)
    with bench(emulator, config) as made, made.nudge("joint2") as grew:
        assert grew == -1
    limit(emulator, 2, 2000, 2100)
    with (
        pytest.raises(JobError, match=r"takes goals 2000 to 2100: no room .* = 2000"),
        bench(emulator, config) as made,
        made.nudge("joint2"),
    ):
        raise AssertionError
    limit(emulator, 2, 0, 4095)
    if emulator.protocol == "dynamixel":
        store(emulator, 2, 36, 2, 0)
    with emulator.motor(2) as motor:
        motor.blocked = True
    said = "pwm_limit = 0" if emulator.protocol == "dynamixel" else "phase = 12"
    monkeypatch.setattr(servo_setup, "_PATIENCE_S", 0.5)
    with (
        pytest.raises(JobError, match=f"joint2 does not move: servo 2, with .*{said}"),
        bench(emulator, config) as made,
        made.nudge("joint2"),
    ):
        raise AssertionError


def test_a_busy_computer_leads_a_servo_all_the_way(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Patience begins when the goal is sent: each step of the way takes longer here."""
    monkeypatch.setattr(servo_setup, "_PATIENCE_S", 0.5)
    write = SerialServoBus.write_goal

    def late(*words: object) -> None:
        time.sleep(0.15)
        write(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(SerialServoBus, "write_goal", late)
    with two("feetech") as emulator:
        config = configured(direct(shell, "sts3215"), emulator)
        with bench(emulator, config) as made:
            with made.nudge("joint2"):
                assert emulator.positions()[2] == pytest.approx(2048 + 57, abs=10.0)
            assert emulator.positions()[2] == pytest.approx(2048, abs=10.0)


@pytest.mark.parametrize("beside", [22, 26])
def test_a_joint_that_does_not_come_back_is_told(
    shell: Shell, emulator: ServoEmulator, beside: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two degrees of the horn may be left, for a gear that gives way."""
    config = configured(direct(shell, MODELS[emulator.protocol]), emulator)
    stays = f"joint2 did not come back .* servo 2 stands {beside} ticks from where it began"
    with bench(emulator, config) as made:
        with contextlib.ExitStack() as told:
            if beside > 24:
                told.enter_context(pytest.raises(JobError, match=stays))
            with made.nudge("joint2") as grew, emulator.motor(2) as motor:
                assert grew == 1
                motor.turn(2048 + beside - motor.position)
                motor.blocked = True
                monkeypatch.setattr(servo_setup, "_PATIENCE_S", 0.5)
        with emulator.motor(2) as motor:
            motor.blocked = False
    assert not any(emulator.torques_on().values())


# ---- written back -------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", MODELS)
def test_what_a_setup_set_is_written_back_after_an_error(
    shell: Shell, protocol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full when the arm's file is written."""
    replace = os.replace

    def full(old: Path, new: Path) -> None:
        if Path(new).name == "servo_driver.yaml":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(old, new)

    mine = folder(shell, MODELS[protocol])
    with geared_bus(protocol) as emulator:
        before = stored(emulator)
        words = ("servo", "setup", mine, "--port", emulator.port, *RIGHT, *POSE_FLAGS)
        with monkeypatch.context() as patch:
            patch.setattr("longarm_comp.core.files.os.replace", full)
            assert "No space" in shell.refused(*words)
        assert stored(emulator) == before
        assert shell(*words) == 0, shell.err
        assert shell.err.count("is set for many turns, as the servo file says") == 3
        now = "operating_mode = 4 instead of operating_mode = 3"
        assert (now if protocol == "dynamixel" else "max_angle_limit = 4095") in shell.err
        assert stored(emulator) != before  # the file says many turns: they stay
        assert not any((shell.folder / "state").rglob("*.json"))


def test_the_driver_lets_no_arm_fall_to_set_turns(shell: Shell, emulator: ServoEmulator) -> None:
    mine = folder(shell, MODELS[emulator.protocol])
    with geared_bus(emulator.protocol) as three:
        config = configured(mine, three)
        with closing(config.open_bus()) as bus:
            bus.set_turns({1: True, 2: True, 3: False})
            for servo_id in (1, 2, 3):
                three._devices[servo_id].motor.switch(True)
        before = stored(three)
        assert "servos hold the arm" in refuses(config) and "[3]" in refuses(config)
        assert stored(three) == before and all(three.torques_on().values())
        for servo_id in (1, 2, 3):
            three._devices[servo_id].motor.switch(False)
        with closing(ServoArm(config)) as arm:
            assert [said.split(",")[0] for said in arm.said] == ["servo 3 is set for many turns"]


def test_the_lock_of_a_servo_is_left_as_it_was() -> None:
    with two("feetech") as emulator:
        emulator._devices[1].put(55, 1, 0)
        servos = dict.fromkeys((1, 2), models()["sts3215"])
        with closing(open_bus("feetech", emulator.port, 1_000_000, servos, 0.2)) as bus:
            bus.set_turns({1: True, 2: True})
        assert [emulator._devices[i].get(55, 1) for i in (1, 2)] == [0, 1]
