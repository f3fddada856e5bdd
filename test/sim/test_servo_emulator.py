"""The emulated bus against the vendors' own client libraries, and its mechanics."""

import contextlib
import math
from pathlib import Path

import pytest
import serial
from faulty_bus import wait_until

from longarm_comp.core.errors import InputError
from longarm_comp.devices.servo_bus.registry import models, open_bus, protocols
from longarm_comp.devices.servo_bus.state import IncompleteReply
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec

dxl = pytest.importorskip("dynamixel_sdk")
scs = pytest.importorskip("scservo_sdk")

START = {1: 2048.0, 2: 1000.0, 7: 3000.0}


def _patience(monkeypatch: pytest.MonkeyPatch, milliseconds: int) -> None:
    """How long the libraries wait: long for an answer on a busy machine, short for a silence."""
    monkeypatch.setattr("scservo_sdk.port_handler.LATENCY_TIMER", milliseconds)
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", milliseconds)


@pytest.fixture
def feetech(monkeypatch: pytest.MonkeyPatch):
    _patience(monkeypatch, 2000)
    with ServoEmulator("feetech", START) as emulator:
        port = scs.PortHandler(emulator.port)
        assert port.openPort()
        yield emulator, scs.sms_sts(port)
        port.closePort()


@pytest.fixture
def dynamixel(monkeypatch: pytest.MonkeyPatch):
    _patience(monkeypatch, 2000)
    with ServoEmulator("dynamixel", START) as emulator:
        port = dxl.PortHandler(emulator.port)
        assert port.openPort()
        yield emulator, port, dxl.PacketHandler(2.0)
        port.closePort()


def test_feetech_library_pings_reads_and_moves(feetech, monkeypatch) -> None:
    emulator, servo = feetech
    assert servo.ping(1) == (777, scs.COMM_SUCCESS, 0)
    assert servo.ReadPos(2) == (1000, scs.COMM_SUCCESS, 0)
    assert servo.WritePosEx(2, 1200, 2000, 0) == (scs.COMM_SUCCESS, 0)
    assert wait_until(lambda: abs(emulator.positions()[2] - 1200) < 0.5)
    assert servo.ReadPos(2)[0] == 1200
    _patience(monkeypatch, 30)
    assert servo.ping(9)[1] == scs.COMM_RX_TIMEOUT


def test_feetech_library_sync_writes_and_sync_reads(feetech) -> None:
    emulator, servo = feetech
    goals = {1: 2100, 2: 900, 7: 3111}
    for servo_id, ticks in goals.items():
        assert servo.SyncWritePosEx(servo_id, ticks, 0, 0)
    assert servo.groupSyncWrite.txPacket() == scs.COMM_SUCCESS
    assert wait_until(lambda: all(abs(emulator.positions()[i] - t) < 0.5 for i, t in goals.items()))
    group = scs.GroupSyncRead(servo, 56, 11)
    for servo_id in goals:
        group.addParam(servo_id)
    assert group.txRxPacket() == scs.COMM_SUCCESS
    assert {i: group.getData(i, 56, 2) for i in goals} == goals
    assert group.getData(1, 62, 1) == 74
    assert group.getData(1, 63, 1) == 25


def test_feetech_library_sees_the_faults(feetech, monkeypatch) -> None:
    emulator, servo = feetech
    emulator.faults.corrupt[1] += 1
    assert servo.ReadPos(1)[1] == scs.COMM_RX_CORRUPT
    _patience(monkeypatch, 30)
    emulator.faults.silent.add(1)
    assert servo.ReadPos(1)[1] == scs.COMM_RX_TIMEOUT
    _patience(monkeypatch, 2000)
    emulator.faults.silent.discard(1)
    with emulator.motor(1) as motor:
        motor.temperature_c = 95.0
    assert wait_until(lambda: servo.ReadPos(1)[2] == 4)


def test_dynamixel_library_pings_reads_and_moves(dynamixel, monkeypatch) -> None:
    emulator, port, packet = dynamixel
    assert packet.ping(port, 1) == (1060, dxl.COMM_SUCCESS, 0)
    assert packet.write1ByteTxRx(port, 2, 64, 1) == (dxl.COMM_SUCCESS, 0)
    assert packet.write4ByteTxRx(port, 2, 116, 1200) == (dxl.COMM_SUCCESS, 0)
    assert wait_until(lambda: abs(emulator.positions()[2] - 1200) < 0.5)
    assert packet.read4ByteTxRx(port, 2, 132) == (1200, dxl.COMM_SUCCESS, 0)
    assert packet.write4ByteTxRx(port, 2, 116, 9999) == (dxl.COMM_SUCCESS, 6)
    assert packet.write1ByteTxRx(port, 2, 11, 4) == (dxl.COMM_SUCCESS, 7)
    _patience(monkeypatch, 30)
    assert packet.ping(port, 9)[1] == dxl.COMM_RX_TIMEOUT


def test_dynamixel_library_sync_writes_and_sync_reads(dynamixel) -> None:
    emulator, port, packet = dynamixel
    write = dxl.GroupSyncWrite(port, packet, 64, 1)
    for servo_id in START:
        write.addParam(servo_id, [1])
    assert write.txPacket() == dxl.COMM_SUCCESS
    goals = {1: 2100, 2: 900, 7: 3111}
    write = dxl.GroupSyncWrite(port, packet, 116, 4)
    for servo_id, ticks in goals.items():
        write.addParam(servo_id, list(ticks.to_bytes(4, "little")))
    assert write.txPacket() == dxl.COMM_SUCCESS
    assert wait_until(lambda: all(abs(emulator.positions()[i] - t) < 0.5 for i, t in goals.items()))
    sync = dxl.GroupSyncRead(port, packet, 132, 4)
    for servo_id in goals:
        sync.addParam(servo_id)
    assert sync.txRxPacket() == dxl.COMM_SUCCESS
    assert {i: sync.getData(i, 132, 4) for i in goals} == goals


def test_dynamixel_library_reads_a_byte_stuffed_value(dynamixel) -> None:
    _, port, packet = dynamixel
    stuffed = 0x00FDFFFF
    assert packet.write4ByteTxRx(port, 1, 84, stuffed) == (dxl.COMM_SUCCESS, 0)
    assert packet.read4ByteTxRx(port, 1, 84) == (stuffed, dxl.COMM_SUCCESS, 0)


def test_dynamixel_library_sees_the_faults(dynamixel) -> None:
    emulator, port, packet = dynamixel
    emulator.faults.corrupt[1] += 1
    assert packet.read4ByteTxRx(port, 1, 132)[1] == dxl.COMM_RX_CORRUPT
    with emulator.motor(1) as motor:
        motor.temperature_c = 95.0
    assert wait_until(lambda: packet.read1ByteTxRx(port, 1, 70)[0] == 4)
    assert packet.read1ByteTxRx(port, 1, 70)[2] == 0x80
    assert packet.write1ByteTxRx(port, 1, 64, 1)[0] == dxl.COMM_SUCCESS
    assert not emulator.torques_on()[1]


def test_offset_reverse_mode_and_profile_of_a_dynamixel(dynamixel) -> None:
    emulator, port, packet = dynamixel
    for address, length, value in ((10, 1, 1 | 4), (20, 4, 5000), (52, 4, 100), (44, 4, 100)):
        write = packet.write1ByteTxRx if length == 1 else packet.write4ByteTxRx
        assert write(port, 1, address, value) == (dxl.COMM_SUCCESS, 0)
    assert packet.read4ByteTxRx(port, 1, 132)[0] == 5000 - 2048
    packet.write1ByteTxRx(port, 1, 64, 1)
    assert packet.write4ByteTxRx(port, 1, 116, 99)[1] == 6
    assert packet.write4ByteTxRx(port, 1, 116, 3000) == (dxl.COMM_SUCCESS, 0)
    assert wait_until(lambda: abs(emulator.positions()[1] - 2000) < 0.5)
    packet.write4ByteTxRx(port, 1, 112, 10000)
    packet.write4ByteTxRx(port, 1, 116, 2000)
    with emulator.motor(1) as motor:  # in 10 s
        assert motor.speed_limit == pytest.approx(100, abs=0.5) and motor.goal == 3000
    packet.write1ByteTxRx(port, 1, 64, 0)
    packet.write1ByteTxRx(port, 1, 10, 0)
    packet.write1ByteTxRx(port, 1, 64, 1)
    packet.write4ByteTxRx(port, 1, 112, 10000)
    with emulator.motor(1) as motor:
        assert motor.speed_limit == pytest.approx(100 * 0.229 * 4096 / 60)


def test_offset_and_modes_of_a_feetech(feetech) -> None:
    emulator, servo = feetech
    device = emulator._devices[1]
    device.put(31, 2, 1 << 11 | 500)
    assert servo.ReadPos(1)[0] == 2548
    servo.WritePosEx(1, 2600, 0, 0)
    assert wait_until(lambda: abs(emulator.positions()[1] - 2100) < 0.5)
    servo.write1ByteTxRx(1, 40, 0)
    emulator.push(1, 2100 + 2 * 4096)
    servo.WritePosEx(1, servo.ReadPos(1)[0] + 100, 0, 0)  # within the turn in which it stands
    assert wait_until(lambda: abs(emulator.positions()[1] - 2200 - 2 * 4096) < 0.5)
    servo.write1ByteTxRx(1, 40, 0)
    emulator.push(1, 2100)
    device.put(33, 1, 3)
    servo.WritePosEx(1, 100, 0, 0)
    assert wait_until(lambda: abs(emulator.positions()[1] - 2200) < 0.5)
    device.put(33, 1, 1)
    servo.WritePosEx(1, 3000, 0, 0)
    with emulator.motor(1) as motor:
        assert motor.goal == pytest.approx(2200, abs=1.0)


def test_motor_keeps_its_speed_limit_and_settles_as_first_order_lag() -> None:
    motor = Motor(MotorSpec(max_speed_ticks_s=1000.0, lag_s=0.05), 0.0)
    motor.torque_on, motor.goal = True, 500.0
    motor.advance(0.1)
    assert motor.position == pytest.approx(100.0)
    motor.advance(0.35)  # 450 = 500 - 1000 * 0.05: the lag begins here
    assert motor.position == pytest.approx(450.0)
    motor.advance(0.05)
    assert motor.position == pytest.approx(500.0 - 50.0 * math.exp(-1.0))


def test_motor_steps_do_not_depend_on_their_size() -> None:
    spec = MotorSpec(dead_band_ticks=2.0, droop_ticks=30.0)
    one, many = Motor(spec, 100.0), Motor(spec, 100.0)
    for motor in (one, many):
        motor.torque_on, motor.goal, motor.external_load = True, 900.0, -0.4
    one.advance(0.7)
    for _ in range(700):
        many.advance(0.001)
    assert one.position == pytest.approx(many.position, abs=1e-6)


def test_a_loaded_motor_hangs_at_the_edge_of_its_dead_band() -> None:
    """From either side: where its effort carries the load, beyond the band."""
    for start in (0.0, 2000.0):
        motor = Motor(MotorSpec(dead_band_ticks=3.0, droop_ticks=50.0), start)
        motor.switch(True)
        motor.goal, motor.external_load = 1000.0, -0.5
        for _ in range(300):
            motor.advance(0.01)
        assert motor.position == pytest.approx(1000.0 - 25.0 - 3.0, abs=1e-3)


def test_motor_rests_on_the_side_it_came_from_and_droops_under_load() -> None:
    spec = MotorSpec(hold_share=0.06, droop_ticks=50.0)
    for start, side in ((0.0, -1.0), (2000.0, 1.0)):
        motor = Motor(spec, start)
        motor.torque_on, motor.goal, motor.external_load = True, 1000.0, -0.5
        motor.advance(5.0)
        assert motor.position == pytest.approx(1000.0 - 25.0 + 3.0 * side)
        assert motor.approach == -side


def test_motor_knows_its_way_since_it_stood_or_turned() -> None:
    motor = Motor(MotorSpec(lag_s=0.05), 100.0)
    motor.torque_on = True
    # A goal, the steps that it is given, and the way then
    for goal, steps, way in ((400, 500, 300), (500, 500, 100), (500, 50, 100), (300, 500, -200)):
        motor.goal = float(goal)
        for _ in range(steps):
            motor.advance(0.01)
        assert motor.way == pytest.approx(way, abs=3.0)


def test_motor_jammed_overloads_and_lets_go() -> None:
    motor = Motor(MotorSpec(overload_s=1.0), 0.0)
    motor.torque_on, motor.goal, motor.blocked = True, 1000.0, True
    for _ in range(90):
        motor.advance(0.01)
    assert motor.torque_on and motor.effort == 1.0
    for _ in range(20):
        motor.advance(0.01)
    assert not motor.torque_on and motor.alarms == {"overload"}


def test_link_follows_an_unplug_and_a_replug(tmp_path: Path) -> None:
    link = tmp_path / "servo"
    with ServoEmulator("feetech", START, link=link) as emulator:
        assert link.resolve() == Path(emulator.port)
        port = scs.PortHandler(str(link))
        assert port.openPort()
        assert scs.sms_sts(port).ping(7)[0] == 777
        emulator.unplug()
        with pytest.raises(OSError):
            port.ser.write(b"\xff\xff\x07\x02\x01\xf5")
        port.closePort()
        with ServoEmulator("feetech", START):  # of another program, whose number may be the same
            assert not link.is_symlink()
        emulator.start()
        assert link.resolve() == Path(emulator.port)
        fresh = scs.PortHandler(str(link))
        assert fresh.openPort()
        assert scs.sms_sts(fresh).ping(7)[0] == 777
        fresh.closePort()
    assert not link.exists()


@pytest.mark.parametrize("protocol", ["feetech", "dynamixel"])
def test_broken_instructions_do_not_stop_it(protocol: str) -> None:
    """Instructions with a good checksum but too few parameters, unknown ones, and a flood."""
    with ServoEmulator(protocol, START) as emulator:
        port = serial.Serial(emulator.port, 1_000_000, timeout=0.2, write_timeout=0.2)
        dialect = protocols()[protocol]()
        for instruction in range(256):
            for params in (b"", b"\x38", b"\x38\x00", b"\xff\xff\xff\xff", bytes([0x38] * 40)):
                port.write(dialect.encode(1, instruction, params))
                port.write(dialect.encode(0xFE, instruction, params))
        assert wait_until(lambda: emulator.frames_heard > 1000)
        port.close()
        servos = {7: models()["sts3215" if protocol == "feetech" else "xl430-w250"]}
        bus = open_bus(protocol, emulator.port, 1_000_000, servos, 0.05)

        def answers() -> bool:
            with contextlib.suppress(IncompleteReply):  # what it heard before comes first
                return bus.read([7])[7].voltage_v > 0
            return False

        assert wait_until(answers)
        bus.close()


CONFIG = """
servo_driver:
  ros__parameters:
    rate_hz: 50.0
    bus: {protocol: feetech, port: /dev/null}
    joints:
      lift: {servo_id: 4, model: sts3215, type: revolute, zero_ticks: 2000, direction: -1,
             gear_ratio: 2.0, lower: 0.1, upper: 0.5, max_velocity: 1.0}
      feed: {servo_id: 2, model: sts3215, type: prismatic, zero_ticks: 100, screw_lead_m: 0.008,
             multi_turn: true, lower: 0.0, upper: 0.03, max_velocity: 0.006}
"""


def test_joints_of_the_configuration_agree_with_the_drivers(tmp_path: Path) -> None:
    """Two conversions, written apart, on the same file."""
    path = tmp_path / "servo_driver.yaml"
    path.write_text(CONFIG)
    arm, config = read_arm(path), ServoConfig.load(path)
    assert arm.protocol == config.bus.protocol
    assert arm.values(arm.start_ticks()) == pytest.approx({"lift": 0.1, "feed": 0.0})
    for value in (0.1, 0.3, 0.5):
        ticks = config.joints["lift"].to_ticks(value)
        assert arm.joints[0].value(ticks) == pytest.approx(config.joints["lift"].to_si(ticks))
        assert arm.joints[0].value(ticks) == pytest.approx(value, abs=8e-4)  # one tick
    ticks = config.joints["feed"].to_ticks(0.02)
    assert arm.joints[1].value(ticks) == pytest.approx(0.02, abs=1e-6)
    path.write_text("joints: {}")
    with pytest.raises(InputError, match=r"bus\.protocol"):
        read_arm(path)
