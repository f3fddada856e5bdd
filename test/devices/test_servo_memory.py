"""What servos have stored: shown by scan, heeded or refused."""

import re
from contextlib import closing
from pathlib import Path

import pytest
from cli_shell import Shell
from servo_bench import (
    MODELS,
    NAMES,
    OFFSETS,
    configured,
    direct,
    folder,
    limit,
    refuses,
    store,
    stored,
    two,
)

from longarm_comp.core.errors import InputError, JobError
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_bus.registry import models, open_bus
from longarm_comp.devices.servo_bus.state import ServoFault
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec

YES = ("--direction", "joint1=+", "--direction", "joint2=-", "--yes", "--ids", "1-2")
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


pytestmark = pytest.mark.usefixtures("nobody_there")


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


def test_a_simulated_servo_has_no_offset_and_counts_from_its_first_turn(shell: Shell) -> None:
    mine = folder(shell, "xl430-w250")
    file = mine / "servo_driver.yaml"
    real = "zero_ticks: 7048.0, stored: {homing_offset: 5000}, "
    file.write_text(re.sub(r"(joint2: .*)zero_ticks: 2048.0, ", rf"\g<1>{real}", file.read_text()))
    driver = BringUp(arm=mine / "arm.yaml", sim=True).parameters("servo_driver", "bus")
    zero = driver["joints.joint2.zero_ticks"]
    config, arm = ServoConfig.load(file), read_arm(file)
    joint = config.joints["joint2"].with_values(zero_ticks=zero, stored={})
    with ServoEmulator("dynamixel", arm.start_ticks()) as emulator:
        bus = open_bus("dynamixel", emulator.port, 1_000_000, config.models, 0.2)
        with closing(bus):
            reads = bus.read([2])[2].position_ticks
    assert 0 <= reads < 4096 and joint.to_si(reads) == 0.0


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
