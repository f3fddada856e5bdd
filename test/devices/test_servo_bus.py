"""Our side of the servo bus: bytes against the vendors' libraries, faults against the emulator."""

import copy
import random
import time
from collections.abc import Iterator
from contextlib import closing

import pytest
from faulty_bus import FaultyBus, wait_until

from longarm_comp.devices.servo_bus.bus import SerialServoBus
from longarm_comp.devices.servo_bus.dialect import Block
from longarm_comp.devices.servo_bus.registry import models, open_bus, protocols
from longarm_comp.devices.servo_bus.state import (
    BusUnplugged,
    IncompleteReply,
    ServoAlarm,
    ServoFault,
)
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.motor import MotorSpec

START = {1: 2048.0, 2: 1000.0, 3: 3000.0, 4: 512.0}
IDS = list(START)
MODEL = {"feetech": "sts3215", "dynamixel": "xl430-w250"}
Rig = tuple[FaultyBus, SerialServoBus]


def _open(protocol: str, port: str, retries: int = 2) -> SerialServoBus:
    servos = dict.fromkeys(IDS, models()[MODEL[protocol]])
    return open_bus(protocol, port, 1_000_000, servos, reply_timeout_s=0.15, retries=retries)


@pytest.fixture(params=sorted(protocols()))
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with FaultyBus(request.param, START, MotorSpec(overload_s=0.3)) as emulator:
        bus = _open(request.param, emulator.port)
        yield emulator, bus
        bus.close()


def test_ping_read_and_move(rig: Rig) -> None:
    _, bus = rig
    assert bus.ping(2) in (777, 1060)
    states = bus.read(IDS)
    assert {i: s.position_ticks for i, s in states.items()} == START
    assert all(s.voltage_v == 7.4 and s.temperature_c == 25.0 for s in states.values())
    bus.torque(IDS, on=True)
    goals = {1: 2100, 2: 940, 3: 3100, 4: 700}
    bus.write_goal(goals, dict.fromkeys(IDS, 2000.0))
    assert wait_until(lambda: {i: s.position_ticks for i, s in bus.read(IDS).items()} == goals)
    assert bus.counters.retries == 0


def test_a_speed_limit_below_one_unit_is_not_no_limit(rig: Rig) -> None:
    emulator, bus = rig
    bus.torque(IDS, on=True)
    bus.write_goal({1: 3000, 2: 3000}, {1: 0.4})  # ticks/s; of servo 2: none
    assert wait_until(lambda: emulator.positions()[2] > 1900.0)  # 0.3 s at the servo's maximum
    assert 2048.0 < emulator.positions()[1] < 2100.0  # a unit of speed is 1 or 16 ticks/s


@pytest.mark.parametrize("lost", [0, 1, 3])
def test_switching_on_never_moves_a_servo_also_one_that_missed_its_goal(
    rig: Rig, lost: int
) -> None:
    """It would go to the goal that it had before: a frame that writes is not acknowledged."""
    emulator, bus = rig
    bus.torque(IDS, on=True)
    bus.write_goal({2: 1500})
    assert wait_until(lambda: abs(emulator.positions()[2] - 1500) < 0.5)
    bus.torque(IDS, on=False)
    emulator.push(2, 1800.0)
    left = iter(range(lost))
    emulator.loses = lambda: next(left, None) is not None
    if lost > 2:  # as often as it is sent
        with pytest.raises(IncompleteReply):
            bus.torque(IDS, on=True)
        assert not any(emulator.torques_on().values())
    else:
        bus.torque(IDS, on=True)
        assert all(emulator.torques_on().values())
    time.sleep(0.1)
    assert emulator.positions()[2] == pytest.approx(1800.0, abs=0.51)


def test_one_silent_servo_is_named_and_the_others_are_not_lost(rig: Rig) -> None:
    emulator, bus = rig
    emulator.faults.silent.add(3)
    with pytest.raises(IncompleteReply, match="in time") as caught:
        bus.read(IDS)
    assert caught.value.facts == {
        "silent": [3], "corrupt": [], "answered": [1, 2, 4], "attempts": 3
    }  # fmt: skip
    assert {i: s.position_ticks for i, s in caught.value.states.items()} == {
        i: t for i, t in START.items() if i != 3
    }
    assert "silent=[3]" in str(caught.value)


def test_a_lost_or_damaged_or_cut_reply_is_asked_for_again(rig: Rig) -> None:
    emulator, bus = rig
    emulator.faults.drops[1] += 1
    emulator.faults.corrupt[2] += 1
    emulator.faults.cuts[3] += 1
    assert sorted(bus.read(IDS)) == IDS
    assert bus.counters.checksum_errors >= 1 and bus.counters.retries >= 1


def test_lasting_damage_is_a_checksum_error(rig: Rig) -> None:
    emulator, bus = rig
    emulator.faults.corrupt[2] += 100
    with pytest.raises(IncompleteReply, match="checksum") as caught:
        bus.read(IDS)
    assert (caught.value.facts["corrupt"], caught.value.facts["silent"]) == ([2], [])
    assert sorted(caught.value.states) == [1, 3, 4]


def test_noise_and_a_late_reply_do_not_become_an_answer(rig: Rig) -> None:
    emulator, bus = rig
    emulator.faults.noise += b"\xff\xff\x00\xff\xff\xfd\x13\xff\xff\x01"
    assert bus.read([1])[1].position_ticks == 2048
    emulator.faults.delays_s[1] = 0.3  # after the 0.15 s time-out: it arrives in the next exchange
    bus.close()
    late = _open(emulator.protocol, emulator.port, retries=0)
    with pytest.raises(IncompleteReply, match="in time"):
        late.read([1])
    emulator.faults.delays_s[1] = 0.0
    time.sleep(0.3)
    emulator.push(1, 555.0)
    assert late.read([1])[1].position_ticks == 555
    assert late.counters.stale_bytes > 0


def test_an_answer_of_another_servo_is_not_taken(rig: Rig) -> None:
    emulator, bus = rig
    dialect = protocols()[emulator.protocol]()
    (frame,) = emulator._wire.take(bytearray(dialect.sync_read([4], dialect.state)))
    ((_, stray),) = emulator._wire.answer(frame, emulator._devices)
    emulator.faults.noise += stray
    assert {i: s.position_ticks for i, s in bus.read([1]).items()} == {1: 2048}
    assert bus.counters.stray_frames == 1


def test_a_late_answer_to_another_question_is_not_taken_from_a_servo_with_an_alarm(
    rig: Rig,
) -> None:
    emulator, bus = rig
    with emulator.motor(1) as motor:
        motor.alarms.add("overload")
    _, emulator.faults.noise = emulator._wire.status(emulator._devices[1], 0, b"\1")
    state = bus.read([1])[1]
    assert (state.position_ticks, state.error_flags) == (2048, ServoAlarm.OVERLOAD)
    assert bus.counters.stray_frames == 1


def test_an_instruction_that_is_refused_is_answered_without_data() -> None:
    with (
        FaultyBus("dynamixel", START) as emulator,
        closing(_open("dynamixel", emulator.port)) as bus,
    ):
        for error, raised in ((7, ServoFault), (0, IncompleteReply)):
            emulator.faults.silent.clear()
            _, emulator.faults.noise = emulator._wire.status(emulator._devices[1], error, b"")
            emulator.faults.silent.add(1)
            with pytest.raises(raised):
                bus.read([1])


def test_overheating_shows_as_an_alarm_and_refuses_torque(rig: Rig) -> None:
    emulator, bus = rig
    bus.torque(IDS, on=True)
    with emulator.motor(4) as motor:
        motor.temperature_c = 95.0
    assert wait_until(lambda: bus.read([4])[4].error_flags == ServoAlarm.OVERHEAT)
    assert bus.read([4])[4].temperature_c > 90
    with pytest.raises(ServoFault) as caught:
        bus.torque([4], on=True)
    assert caught.value.facts == {"id": 4, "alarm": "OVERHEAT"}


def test_a_jammed_servo_shows_load_then_overload(rig: Rig) -> None:
    emulator, bus = rig
    bus.torque(IDS, on=True)
    with emulator.motor(1) as motor:
        motor.blocked = True
    bus.write_goal({1: 3000})
    assert wait_until(lambda: bus.read([1])[1].load > 0.95)
    assert wait_until(lambda: bus.read([1])[1].error_flags == ServoAlarm.OVERLOAD)


def test_an_unplugged_bus_is_said_so_and_can_be_opened_again(rig: Rig) -> None:
    emulator, bus = rig
    assert sorted(bus.read(IDS)) == IDS
    emulator.unplug()
    for action in (
        lambda: bus.read(IDS),
        lambda: bus.write_goal({1: 2000}),
        lambda: bus.torque(IDS, on=False),
    ):
        with pytest.raises(BusUnplugged):
            action()
    bus.close()
    emulator.start()
    again = _open(emulator.protocol, emulator.port)
    assert sorted(again.read(IDS)) == IDS
    again.close()


def test_many_turns_are_set_once_and_then_used(rig: Rig) -> None:
    _, bus = rig
    (said,) = bus.set_turns({1: True, 2: False})
    assert said.startswith("servo 1 is set for many turns")
    assert bus.set_turns({1: True, 2: False}) == []
    bus.torque([1], on=True)
    bus.write_goal({1: -900})
    assert wait_until(lambda: bus.read([1])[1].position_ticks == -900)


def test_turns_are_kept_without_power_and_torque_is_not(rig: Rig) -> None:
    emulator, bus = rig
    bus.set_turns({1: True})
    bus.torque(IDS, on=True)
    emulator.power_cycle(1)
    assert emulator.torques_on() == {1: False, 2: True, 3: True, 4: True} == bus.driven(IDS)
    assert bus.set_turns({1: True}) == []


def test_an_adapter_that_hears_itself_changes_nothing(rig: Rig) -> None:
    emulator, bus = rig
    emulator.echo = True
    bus.torque(IDS, on=True)
    bus.write_goal({2: 1111})
    assert wait_until(lambda: bus.read(IDS)[2].position_ticks == 1111)
    assert bus.counters.retries == bus.counters.checksum_errors == 0


def test_torque_off_reaches_the_others_although_one_is_silent(rig: Rig) -> None:
    emulator, bus = rig
    bus.torque(IDS, on=True)
    emulator.faults.silent.add(1)
    with pytest.raises(IncompleteReply, match="in time") as caught:
        bus.torque(IDS, on=False)
    assert caught.value.facts["silent"] == [1]
    assert not any(emulator.torques_on().values())


def test_the_port_is_for_one_process_and_must_exist(rig: Rig) -> None:
    emulator, _ = rig
    with pytest.raises(BusUnplugged, match="not usable"):
        _open("feetech", emulator.port)
    with pytest.raises(BusUnplugged, match="no-such-port"):
        _open("feetech", "/dev/no-such-port")


class _Line:
    """A serial port for a vendor's library that keeps what is written to it."""

    is_using = False

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def clearPort(self) -> None:  # noqa: N802 - the library's name
        pass

    def setPacketTimeout(self, length: int) -> None:  # noqa: N802
        pass

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self.sent.append(bytes(packet))
        self.is_using = False
        return len(packet)


def test_dynamixel_frames_equal_the_vendor_librarys() -> None:
    dxl = pytest.importorskip("dynamixel_sdk")
    line, packet, ours = _Line(), dxl.PacketHandler(2.0), protocols()["dynamixel"]()
    packet.syncReadTx(line, 122, 25, [1, 2, 7], 3, False)
    line.is_using = False
    goal = ours.goal_bytes(-123456, 100.0)
    packet.syncWriteTxOnly(line, 108, 12, [3, *goal], 13)
    assert line.sent == [
        ours.sync_read([1, 2, 7], Block(122, 25)),
        ours.sync_write(Block(108, 12), {3: goal}),
    ]


def test_dynamixel_byte_stuffing_equals_the_vendor_librarys() -> None:
    dxl = pytest.importorskip("dynamixel_sdk")
    packet, ours = dxl.PacketHandler(2.0), protocols()["dynamixel"]()
    goal = ours.goal_bytes(0x00FDFFFF, 100.0)
    frame = ours.sync_write(Block(108, 12), {3: goal})
    plain = [0xFF, 0xFF, 0xFD, 0, 0xFE, 20, 0, 0x83, 108, 0, 12, 0, 3, *goal, 0, 0]
    # The library's own txPacket drops what addStuffing returns, so its result is taken here.
    stuffed = packet.addStuffing(plain)
    stuffed[:4] = plain[:4]
    stuffed[4] = plain[4]
    crc = packet.updateCRC(0, stuffed, len(stuffed) - 2)
    assert frame == bytes(stuffed[:-2]) + crc.to_bytes(2, "little")
    assert len(frame) == len(plain) + 1


def test_feetech_frames_equal_the_vendor_librarys() -> None:
    scs = pytest.importorskip("scservo_sdk")
    line, ours = _Line(), protocols()["feetech"]()
    servo = scs.sms_sts(line)
    servo.syncReadTx(56, 11, [1, 2, 7], 3)
    line.is_using = False
    servo.SyncWritePosEx(3, -900, 1234, 0)
    servo.groupSyncWrite.txPacket()
    assert line.sent == [
        ours.sync_read([1, 2, 7], Block(56, 11)),
        ours.sync_write(Block(41, 7), {3: ours.goal_bytes(-900, 1234.0)}),
    ]


def test_decoding_survives_any_split_of_the_bytes() -> None:
    for protocol in protocols():
        with ServoEmulator(protocol, START) as emulator:
            dialect = protocols()[protocol]()
            asked = dialect.sync_read(IDS, dialect.state)
            frames = emulator._wire.take(bytearray(asked))
            stream = b"".join(r for _, r in emulator._wire.answer(frames[0], emulator._devices))
        whole = dialect.decode(bytearray(stream), final=True)
        assert [reply.servo_id for reply in whole] == IDS
        for cut in range(len(stream)):
            buffer = bytearray(stream[:cut])
            replies = dialect.decode(buffer, final=False)
            buffer += stream[cut:]
            assert replies + dialect.decode(buffer, final=True) == whole


@pytest.mark.parametrize("protocol", sorted(protocols()))
def test_a_whole_frame_is_found_in_any_garbage(protocol: str) -> None:
    """No false answer, no exception, and the true one is not lost behind garbage."""
    rng = random.Random(5)
    dialect = protocols()[protocol]()
    alphabet = (0xFF, 0xFF, 0xFF, 0xFD, 0x00, 0x55, 1, 7, 200)
    emulator = ServoEmulator(protocol, START)
    frame = emulator._wire.take(bytearray(dialect.sync_read([3], dialect.state)))[0]
    ((_, answer),) = emulator._wire.answer(frame, emulator._devices)
    (true,) = dialect.decode(bytearray(answer), final=True)
    false = 0
    for _ in range(2000):
        junk = bytes(rng.choice(alphabet) for _ in range(rng.randrange(30)))
        replies = dialect.decode(bytearray(junk + answer), final=True)
        intact = [reply for reply in replies if reply.intact and reply.data]
        assert true in intact
        false += len(intact) - 1
    assert false == 0


def test_errors_cross_a_process_boundary() -> None:
    for error in (
        IncompleteReply("late", {}, silent=[3], answered=[2]),
        BusUnplugged(port="/dev/x", why="gone"),
        ServoFault("the servo reports an alarm", id=1, alarm="OVERHEAT"),
    ):
        assert str(copy.copy(error)) == str(error)
