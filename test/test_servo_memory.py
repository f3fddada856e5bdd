"""What servos have stored: shown by scan, respected or refused, and written back."""

from __future__ import annotations

import errno
import io
import itertools
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from cli_shell import Shell
from servo_bench import POSE_FLAGS, direct, folder
from servo_bench import bus as geared_bus
from test_servo_setup import MODELS, RIGHT, Terminal

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.registry import models, open_bus
from longarm_comp.devices.servo_bus.state import ServoFault
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_setup import ServoSetup
from longarm_comp.devices.setup_journal import SetupJournal
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
from longarm_comp.sim.servo_emulator.wire import Device

YES = ("--direction", "joint1=+", "--direction", "joint2=-", "--yes", "--ids", "1-2")
OFFSETS = {"feetech": (31, 2, 1 << 11 | 300), "dynamixel": (20, 4, 300)}
"""Address, length and value with which a servo says 300 ticks more than its encoder."""
LIMITS = {"feetech": ((9, 2), (11, 2)), "dynamixel": ((52, 4), (48, 4))}
NAMES = {
    "feetech": ("min_angle_limit", "max_angle_limit"),
    "dynamixel": ("min_position_limit", "max_position_limit"),
}
REFUSED = [
    ("dynamixel", 10, 1, 4, "drive_mode_time_based = 1 (register 10); allowed: 0"),
    ("dynamixel", 11, 1, 1, "operating_mode = 1 (register 11); allowed: 3 or 4"),
    ("dynamixel", 11, 1, 5, "operating_mode = 5 (register 11); allowed: 3 or 4"),
    ("dynamixel", 44, 4, 3, "velocity_limit = 3 (register 44)"),
    ("feetech", 33, 1, 1, "operating_mode = 1 (register 33); allowed: 0"),
    ("feetech", 33, 1, 3, "operating_mode = 3 (register 33); allowed: 0"),
    ("feetech", 30, 1, 2, "angular_resolution = 2 (register 30); allowed: 1"),
]
"""Protocol, address, length and value of what gives goals or speeds another meaning."""


@pytest.fixture(autouse=True)
def nobody_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@contextmanager
def two(protocol: str, *at: float, spec: MotorSpec | None = None) -> Iterator[ServoEmulator]:
    """Two directly driven servos, with the ids 1 and 2."""
    with ServoEmulator(protocol, dict(enumerate(at or (2048.0, 2048.0), 1)), spec) as emulator:
        yield emulator


@pytest.fixture(params=MODELS)
def emulator(request: pytest.FixtureRequest) -> Iterator[ServoEmulator]:
    with two(request.param) as made:
        yield made


def store(emulator: ServoEmulator, servo_id: int, address: int, length: int, value: int) -> None:
    device = emulator._devices[servo_id]
    device.put(address, length, value)
    device.kept = bytes(device.memory)


def limit(emulator: ServoEmulator, servo_id: int, low: int, high: int) -> None:
    for (address, length), value in zip(LIMITS[emulator.protocol], (low, high), strict=True):
        store(emulator, servo_id, address, length, value)


def stored(emulator: ServoEmulator) -> dict[int, bytes]:
    """What outlives a loss of power, by id."""
    kept = emulator._wire.kept_below
    return {i: device.kept[:kept] for i, device in emulator._devices.items()}


def configured(mine: Path, emulator: ServoEmulator) -> ServoConfig:
    file = mine / "servo_driver.yaml"
    file.write_text(re.sub(r"port: [^,]+", f"port: {emulator.port}", file.read_text()))
    return ServoConfig.load(file)


def refuses(config: ServoConfig) -> str:
    """Why the driver does not begin with the servos."""
    with pytest.raises(JobError) as caught:
        ServoArm(config)
    return str(caught.value)


# ---- scan ---------------------------------------------------------------------------------------


def test_scan_shows_what_decides_the_meaning_of_a_goal(
    shell: Shell, emulator: ServoEmulator
) -> None:
    limit(emulator, 2, 700, 3400)
    store(emulator, 2, *OFFSETS[emulator.protocol])
    words = ("servo", "scan", "--port", emulator.port, "--ids", "1-2")
    words += ("--protocol", emulator.protocol, "--baud", 1000000)
    first, second = shell.json(*words)["servos"]
    low, high = NAMES[emulator.protocol]
    assert (first["memory"][low], first["memory"][high]) == (0, 4095)
    assert (second["memory"][low], second["memory"][high]) == (700, 3400)
    offset = -300 if emulator.protocol == "feetech" else 300
    assert (first["memory"]["homing_offset"], second["memory"]["homing_offset"]) == (0, offset)
    assert "operating_mode" in first["memory"]
    assert shell(*words) == 0
    line = next(line for line in shell.out.splitlines() if "700" in line)
    assert f"{high} = 3400" in line and f"homing_offset = {offset}" in line
    assert not any("homing_offset" in row for row in shell.out.splitlines() if row != line)


def test_scan_reads_the_drive_mode_bit_by_bit(shell: Shell) -> None:
    with two("dynamixel") as emulator:
        store(emulator, 1, 10, 1, 1)
        store(emulator, 2, 10, 1, 4)
        words = ("--port", emulator.port, "--protocol", "dynamixel", "--baud", 1000000)
        found = shell.json("servo", "scan", *words, "--ids", "1-2")["servos"]
    modes = [(s["memory"]["drive_mode_reverse"], s["memory"]["drive_mode_time_based"])
             for s in found]  # fmt: skip
    assert modes == [(1, 0), (0, 1)]


def test_scan_shows_alarms_and_setup_moves_nothing_then(
    shell: Shell, emulator: ServoEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = direct(shell, MODELS[emulator.protocol])
    monkeypatch.setattr(Motor, "clear_alarms", lambda motor: None)  # the supply stays low
    with emulator.motor(2) as motor:
        motor.alarms, motor.voltage_v = {"voltage"}, 4.6
    words = ("--port", emulator.port, "--protocol", emulator.protocol, "--baud", 1000000)
    assert shell("servo", "scan", *words, "--ids", "1-2") == 0
    assert shell.out.count("VOLTAGE (at 4.6 V") == 1
    found = shell.json("servo", "scan", *words, "--ids", "1-2")["servos"]
    assert [bool(s["alarm"]) for s in found] == [False, True]
    said = shell.refused("servo", "setup", mine, "--port", emulator.port, *YES, code=3)
    assert "servo 2 of joint2 reports VOLTAGE (at 4.6 V" in said


def test_other_models_get_their_next_step(shell: Shell) -> None:
    mine = direct(shell, "sts3215")
    spec = {1: MotorSpec(), 2: MotorSpec(model=2825)}
    with ServoEmulator("feetech", {1: 2048.0, 2: 2048.0}, spec) as emulator:
        assert "sts3250" in refuses(configured(mine, emulator))
        assert "longarm servo setup" in refuses(configured(mine, emulator))
        words = ("--port", emulator.port, "--protocol", "feetech", "--baud", 1000000)
        assert shell("servo", "scan", *words, "--ids", "1-2") == 0
        assert "next: longarm servo setup DIR" in shell.err
        assert shell("servo", "setup", mine, "--port", emulator.port, *YES) == 0
        assert "servo 2 is a sts3250" in shell.err
        ServoArm(configured(mine, emulator)).close()
    spec[2] = MotorSpec(model=2307)
    with ServoEmulator("feetech", {1: 2048.0, 2: 2048.0}, spec) as emulator:
        words = ("--port", emulator.port, "--protocol", "feetech", "--baud", 1000000)
        assert shell("servo", "scan", *words, "--ids", "1-2") == 0
        step = "unknown model 2307 (known: sts3215, sts3250)"
        assert step in shell.err and "add_a_protocol.md" in shell.err
        said = shell.refused("servo", "setup", mine, "--port", emulator.port, *YES, code=3)
        assert step in said


# ---- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(("protocol", "address", "length", "value", "said"), REFUSED)
def test_another_meaning_of_a_goal_is_refused_before_anything_moves(
    shell: Shell, protocol: str, address: int, length: int, value: int, said: str
) -> None:
    mine = direct(shell, MODELS[protocol])
    with two(protocol) as emulator:
        store(emulator, 2, address, length, value)
        before = stored(emulator)
        words = ("servo", "setup", mine, "--port", emulator.port)
        assert said in shell.refused(*words, *YES, code=3)
        assert said in refuses(configured(mine, emulator))
        assert stored(emulator) == before
        assert not any(emulator.torques_on().values())
        assert emulator.positions() == {1: 2048.0, 2: 2048.0}


def test_a_register_that_is_changed_while_the_driver_runs_is_found_at_torque_on(
    shell: Shell,
) -> None:
    mine = direct(shell, "xl430-w250")
    with two("dynamixel") as emulator:
        arm = ServoArm(configured(mine, emulator))
        with closing(arm):
            arm.power(True)
            arm.power(False)
            store(emulator, 2, 10, 1, 4)
            with pytest.raises(JobError, match="drive_mode_time_based"):
                arm.power(True)
            store(emulator, 2, 10, 1, 0)
            store(emulator, 2, 11, 1, 4)
            with pytest.raises(JobError, match="set for other turns"):
                arm.power(True)
            assert not arm.powered and not any(emulator.torques_on().values())


def test_torque_off_also_reaches_servos_that_are_refused(
    shell: Shell, emulator: ServoEmulator, tmp_path: Path
) -> None:
    mine, link = direct(shell, MODELS[emulator.protocol]), tmp_path / "bus"
    emulator.unplug()
    emulator._link = link
    emulator.start()
    config = configured(mine, emulator)
    arm = ServoArm(ServoConfig.parse(
        config.model_dump() | {"bus": config.bus.model_dump() | {"port": str(link)}}, "here"
    ))  # fmt: skip
    with closing(arm):
        arm.power(True)
        emulator.unplug()
        assert "unplugged" in arm.cycle(0.0).trouble or arm.bus is None
        with pytest.raises(JobError):
            arm.power(False)
        store(emulator, 2, *OFFSETS[emulator.protocol])
        emulator.start()
        assert all(emulator.torques_on().values())
        assert "homing_offset" in arm.cycle(10.0).trouble
        assert not any(emulator.torques_on().values())


def test_limits_of_a_servo_are_kept_and_named(shell: Shell, emulator: ServoEmulator) -> None:
    """They are within one turn, and leave or do not leave the joint its own."""
    mine = direct(shell, MODELS[emulator.protocol])
    words = ("servo", "setup", mine, "--port", emulator.port)
    limit(emulator, 2, 700, 3400)
    before = stored(emulator)
    assert shell(*words, *YES) == 0, shell.err
    config = configured(mine, emulator)
    ServoArm(config).close()
    assert stored(emulator) == before
    first, last = config.joints["joint2"].tick_limits
    limit(emulator, 2, first, last)
    ServoArm(config).close()
    for low, high in ((first + 1, 3400), (700, last - 1)):
        limit(emulator, 2, low, high)
        before = stored(emulator)
        named = f"{NAMES[emulator.protocol][low == 700]} = {high if low == 700 else low}"
        for said in (shell.refused(*words, *YES, code=3), refuses(configured(mine, emulator))):
            assert f"takes goals {low} to {high}" in said and named in said
        assert stored(emulator) == before
    limit(emulator, 2, 700, 3400)
    file = mine / "servo_driver.yaml"
    file.write_text(file.read_text().replace("multi_turn: false", "multi_turn: true"))
    before = stored(emulator)
    for said in (shell.refused(*words, *YES, code=3), refuses(configured(mine, emulator))):
        assert "limits within one turn" in said and f"{NAMES[emulator.protocol][0]} = 700" in said
    assert stored(emulator) == before


def test_a_servo_that_would_jump_gets_no_torque(shell: Shell, emulator: ServoEmulator) -> None:
    mine = direct(shell, MODELS[emulator.protocol])
    file = mine / "servo_driver.yaml"
    file.write_text(re.sub(r"(joint2: .*)lower: [-.0-9]+", r"\1lower: 0.0", file.read_text()))
    emulator.push(2, 1900.0)
    for low, high in ((2040, 3400), (700, 1850)):
        limit(emulator, 2, low, high)
        servos = dict.fromkeys((1, 2), models()[MODELS[emulator.protocol]])
        bus = open_bus(emulator.protocol, emulator.port, 1_000_000, servos, 0.2)
        with closing(bus), pytest.raises(ServoFault, match=f"its own limits {low} to {high}"):
            bus.torque([1, 2], on=True)
        assert not any(emulator.torques_on().values())
    for low, high in ((1900, 3400), (700, 1900)):
        limit(emulator, 2, low, high)
        with closing(open_bus(emulator.protocol, emulator.port, 1_000_000, servos, 0.2)) as bus:
            bus.torque([1, 2], on=True)
            bus.torque([1, 2], on=False)
    limit(emulator, 2, 2040, 3400)
    said = shell.refused("servo", "setup", mine, "--port", emulator.port, *YES, code=3)
    assert "stands at 1900, beyond its own limits 2040 to 3400" in said
    arm = ServoArm(configured(mine, emulator))
    with closing(arm), pytest.raises(ServoFault, match="2040"):
        arm.power(True)
    assert emulator.positions()[2] == 1900.0


def test_a_speed_beyond_the_servos_own_is_not_sent(shell: Shell) -> None:
    """1.5 times the joint's speed is sent; a servo with less takes no goal at all."""
    mine = direct(shell, "xl430-w250")
    with two("dynamixel") as emulator:
        config = configured(mine, emulator)
        fastest = config.joints["joint2"].max_speed_ticks_s
        unit = 0.229 / 60 * 4096
        store(emulator, 2, 44, 4, int(1.2 * fastest / unit))
        arm = ServoArm(config)
        with closing(arm):
            assert arm._speeds[1] == pytest.approx(1.5 * fastest)
            assert arm._speeds[2] == int(1.2 * fastest / unit) * unit


# ---- an offset, and a reversed servo ------------------------------------------------------------


def test_zeros_hold_with_an_offset_and_the_driver_knows_it(
    shell: Shell, emulator: ServoEmulator
) -> None:
    mine = direct(shell, MODELS[emulator.protocol])
    store(emulator, 1, *OFFSETS[emulator.protocol])
    words = ("servo", "setup", mine, "--port", emulator.port, *YES, "--pose", "joint1=10")
    joint = shell.json(*words)["joints"]["joint1"]
    assert joint["zero_ticks"] == round(2048 + 300 - 4096 * 10 / 360)
    offset = -300 if emulator.protocol == "feetech" else 300
    assert joint["stored"] == {"homing_offset": offset}
    config = configured(mine, emulator)
    assert config.joints["joint1"].stored == {"homing_offset": offset}
    arm = ServoArm(config)
    with closing(arm):
        arm.power(True)
        assert arm.cycle(0.0).joints["joint1"].position == pytest.approx(0.1745, abs=1e-3)
    store(emulator, 1, OFFSETS[emulator.protocol][0], OFFSETS[emulator.protocol][1], 0)
    assert f"homing_offset = 0 (register {OFFSETS[emulator.protocol][0]}); allowed: {offset}" in (
        refuses(config)
    )
    store(emulator, 2, *OFFSETS[emulator.protocol])
    store(emulator, 1, *OFFSETS[emulator.protocol])
    assert f"servo 2 of joint2: homing_offset = {offset}" in refuses(config)
    simulated = BringUp(arm=mine / "arm.yaml", sim=True).parameters("servo_driver", "bus")
    assert simulated["joints.joint1.stored.homing_offset"] == 0  # emulated servos have none
    real = BringUp(arm=mine / "arm.yaml").parameters("servo_driver", "")
    assert not any("stored" in name for name in real)
    assert shell("check", mine) in (0, 3), shell.err


def test_a_servo_that_is_reversed_after_the_setup_is_refused(shell: Shell) -> None:
    mine = direct(shell, "xl430-w250")
    with two("dynamixel") as emulator:
        emulator._devices[2].motor.position = emulator._devices[2].motor.seen = -2000.0
        store(emulator, 2, 10, 1, 1)
        found = shell.json("servo", "setup", mine, "--port", emulator.port, *YES)
        assert found["joints"]["joint2"]["stored"] == {"drive_mode_reverse": 1}
        assert found["joints"]["joint2"]["zero_ticks"] == 2000.0
        config = configured(mine, emulator)
        ServoArm(config).close()
        store(emulator, 2, 10, 1, 0)
        assert "drive_mode_reverse = 0 (register 10); allowed: 1" in refuses(config)


def test_only_registers_of_the_protocol_are_declared(shell: Shell) -> None:
    mine = direct(shell, "sts3215")
    file = mine / "servo_driver.yaml"
    text = file.read_text()
    for word in ("drive_mode_reverse: 1", "operating_mode: 0"):
        file.write_text(text.replace("lower:", f"stored: {{{word}}}, lower:", 1))
        with pytest.raises(InputError, match=r"allowed: of a sts3215: .*homing_offset"):
            ServoConfig.load(file)


# ---- the nudge ----------------------------------------------------------------------------------


@contextmanager
def bench(emulator: ServoEmulator, config: ServoConfig) -> Iterator[ServoSetup]:
    with closing(config.open_bus()) as bus, ServoSetup(bus, config.joints).safely() as made:
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
    with bench(emulator, configured(mine, emulator)) as made, made.nudged("joint2") as grew:
        assert grew == 1
        assert emulator.positions()[2] == pytest.approx(2048 + 57, abs=6.5)
    assert (sent[0] - 2048, max(sent)) == (0, 2048 + 57)
    assert max(abs(b - a) for a, b in itertools.pairwise(sent)) <= 7
    assert emulator.positions()[2] == pytest.approx(2048, abs=6.5)


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
        with pytest.raises(JobError, match=words), made.nudged("joint2"):
            raise AssertionError
        assert emulator.torques_on() == {1: True, 2: False}
    assert not any(emulator.torques_on().values())
    assert abs(emulator.positions()[2] - 2048) < 450


def test_a_nudge_stays_within_the_servos_limits_or_names_them(
    shell: Shell, emulator: ServoEmulator
) -> None:
    mine = direct(shell, MODELS[emulator.protocol])
    limit(emulator, 2, 1500, 2050)
    config = configured(mine, emulator)
    with bench(emulator, config) as made, made.nudged("joint2") as grew:
        assert grew == -1
    limit(emulator, 2, 2000, 2100)
    with (
        pytest.raises(JobError, match=r"takes goals 2000 to 2100: no room .* = 2000"),
        bench(emulator, config) as made,
        made.nudged("joint2"),
    ):
        raise AssertionError
    limit(emulator, 2, 0, 4095)
    if emulator.protocol == "dynamixel":
        store(emulator, 2, 36, 2, 0)
    with emulator.motor(2) as motor:
        motor.blocked = True
    said = "pwm_limit = 0" if emulator.protocol == "dynamixel" else "phase = 12"
    with (
        pytest.raises(JobError, match=f"joint2 does not move: servo 2, with .*{said}"),
        bench(emulator, config) as made,
        made.nudged("joint2"),
    ):
        raise AssertionError


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


@pytest.mark.parametrize("protocol", MODELS)
def test_what_a_setup_set_is_written_back_after_ctrl_c_and_after_a_kill(
    shell: Shell, protocol: str
) -> None:
    mine = folder(shell, MODELS[protocol])
    with geared_bus(protocol) as emulator:
        before = stored(emulator)
        words = ("servo", "setup", mine, "--ids", "1-3", "--port", emulator.port, "--yes")
        broken = Terminal(*words)
        broken.until("joint1: which way")
        assert stored(emulator) != before
        assert broken.stop() == 130
        assert stored(emulator) == before

        killed = Terminal(*words)
        killed.until("joint1: which way")
        killed.kill()
        changed = stored(emulator)
        assert changed != before
        scan = ("servo", "scan", "--port", emulator.port, "--ids", "1-3")
        assert shell(*scan) == 0
        assert "a setup was broken off: servos [1, 2, 3]" in shell.err
        assert stored(emulator) == changed
        with pytest.raises(AssertionError):  # of ours: the bench is left by an error
            setup_of(mine, emulator)
        assert stored(emulator) == before
        assert shell(*scan) == 0 and "broken off" not in shell.err

        again = Terminal(*words)
        again.until("joint1: which way")
        again.kill()
        for servo_id in (1, 2, 3):
            emulator._devices[servo_id].motor.switch(False)
        with closing(ServoArm(configured(mine, emulator))) as arm:
            assert any("broken off" in said for said in arm.said)
        assert shell(*scan) == 0 and "broken off" not in shell.err


def setup_of(mine: Path, emulator: ServoEmulator) -> None:
    config = configured(mine, emulator)
    with closing(config.open_bus()) as bus, ServoSetup(bus, config.joints).safely():
        raise AssertionError


def test_the_journal_waits_for_a_silent_servo_and_is_not_guessed_when_damaged(
    shell: Shell, emulator: ServoEmulator
) -> None:
    mine = folder(shell, MODELS[emulator.protocol])
    with geared_bus(emulator.protocol) as three:
        before = stored(three)
        config = configured(mine, three)
        with (
            pytest.raises(JobError, match="torque may be on") as caught,
            closing(config.open_bus()) as bus,
            ServoSetup(bus, config.joints).safely(),
        ):
            three.faults.silent.add(2)
        assert caught.value
        three.faults.silent.clear()
        journal = SetupJournal(three.port)
        with closing(config.open_bus()) as bus:
            three.faults.silent.add(2)
            assert journal.write_back(bus) == [2]
            assert sorted(journal.read(three.protocol)) == [2]
            three.faults.silent.clear()
            assert journal.write_back(bus) == [] and stored(three) == before
        journal.begin(three.protocol, {1: (b"first", b"a")})
        journal.begin(three.protocol, {1: (b"second", b"b"), 2: (b"other", b"c")})
        assert journal.read(three.protocol) == {1: (b"first", b"a"), 2: (b"other", b"c")}
        journal.end(three.protocol, [1])
        assert journal.read(three.protocol) == {2: (b"other", b"c")}
        assert journal.read("another") == {}
        journal.path.write_text('{"protocol": "feetech", "turns": {"1": 5}}')
        scan = ("servo", "scan", "--port", three.port, "--ids", "1-3")
        assert f"{journal.path} is damaged" in shell.refused(*scan, code=3)
        assert "is damaged" in refuses(config)
        words = ("servo", "setup", mine, "--port", three.port, *RIGHT)
        assert "is damaged" in shell.refused(*words, code=3)


def test_what_somebody_set_meanwhile_is_left(shell: Shell) -> None:
    with two("feetech") as emulator:
        servos = {1: models()["sts3215"]}
        with closing(open_bus("feetech", emulator.port, 1_000_000, servos, 0.2)) as bus:
            journal = SetupJournal(emulator.port)
            journal.begin("feetech", {1: (b"\0\0\xff\x0f", bytes(4))})
            limit(emulator, 1, 100, 200)
            assert journal.write_back(bus) == []
            assert bus.memory([1])[1].goals == (100, 200)
            assert not os.path.exists(journal.path)


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
