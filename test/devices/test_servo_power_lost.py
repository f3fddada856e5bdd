"""Servos that a fault has to stop, that lost their power, or that are others than before."""

import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from driven_arm import HORN, MODEL, RACK, Driven, driven_arm
from faulty_bus import wait_until

from longarm_comp.core.errors import JobError
from longarm_comp.devices.follower_report import FollowerState
from longarm_comp.devices.servo_bus.state import BusUnplugged, IncompleteReply
from longarm_comp.sim.servo_emulator.wire import Device


@pytest.fixture(params=sorted(MODEL))
def driven(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Driven]:
    with driven_arm(request.param, tmp_path) as made:
        yield made


def _overheat(driven: Driven, servo_id: int) -> None:
    with driven.emulator.motor(servo_id) as motor:
        motor.temperature_c = 68.0


def _run_away(driven: Driven) -> None:
    """Send the shoulder far, as if goals that stop it were lost."""
    driven.send(shoulder=0.9)
    driven.cycles(3)
    assert driven.arm.bus is not None
    driven.arm.bus.write_goal({1: 30000}, {1: 700.0})
    assert wait_until(lambda: driven.emulator.each(lambda motor: motor.goal)[1] == 30000.0)


def test_a_servo_that_misses_a_faults_goal_is_held_where_it_got_to_and_the_others_once(
    driven: Driven, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loaded servo sinks by its droop each time it is held where it stands."""
    wire, deaf, heard = driven.emulator._wire, {1}, []
    write = wire.write

    def hear(device: Device, address: int, data: bytes) -> int:
        heard.append(device.servo_id)
        return 0 if device.servo_id in deaf else write(device, address, data)

    _run_away(driven)
    monkeypatch.setattr(wire, "write", hear)
    _overheat(driven, 2)
    driven.becomes(FollowerState.FAULT)
    heard.clear()
    got_to = driven.joints()["shoulder"] + 0.3
    driven.until(lambda cycle: driven.joints()["shoulder"] > got_to and "[1]" in cycle.trouble)
    deaf.clear()
    driven.until(lambda cycle: not cycle.trouble)
    driven.cycles(20)
    assert set(heard) == {1}
    each = driven.emulator.each
    driven.until(lambda _: each(lambda motor: abs(motor.goal - motor.position) < 1.0)[1])
    assert driven.joints()["shoulder"] > got_to - 0.1


def test_a_servo_of_another_model_gets_no_torque_after_a_fault(driven: Driven) -> None:
    """Somebody replaced it meanwhile."""
    emulator = driven.emulator
    _overheat(driven, 2)
    driven.becomes(FollowerState.FAULT)
    emulator.power_cycle(2)
    with emulator.motor(2) as motor:
        motor.temperature_c = 30.0
        emulator._devices[2].put(*{"feetech": (3, 2), "dynamixel": (0, 2)}[emulator.protocol], 9)
    driven.until(lambda cycle: cycle.joints and cycle.states[2].temperature_c < 40.0)
    with pytest.raises(JobError, match="boom is not the configured servo"):
        driven.arm.release(time.monotonic())
    assert emulator.torques_on() == {1: True, 2: False}


def _comes_back_moved(driven: Driven, servo_id: int, by: float) -> None:
    driven.emulator.unplug()
    driven.until(lambda _: driven.arm.bus is None)
    with driven.emulator.motor(servo_id) as motor:
        motor.turn(by)
        motor.goal = motor.position
    driven.emulator.start()


@pytest.mark.parametrize("servo_id", [1, 2])
@pytest.mark.parametrize("by", [410.0, -410.0])
def test_another_arm_on_the_port_is_sent_nothing_until_the_driver_is_configured_again(
    driven: Driven, servo_id: int, by: float
) -> None:
    driven.cycles(3)
    _comes_back_moved(driven, servo_id, by)
    driven.until(lambda cycle: "another arm, or the arm was moved" in cycle.trouble)
    assert driven.arm.bus is None
    assert driven.arm.doubt.startswith(["shoulder", "boom"][servo_id - 1])
    with driven.emulator.motor(servo_id) as motor:
        motor.turn(-by)
        motor.goal = motor.position
    driven.until(lambda cycle: cycle.joints)  # its own
    assert not driven.arm.doubt


def test_an_arm_that_gave_way_a_little_or_was_without_torque_is_taken_back(driven: Driven) -> None:
    driven.cycles(3)
    _comes_back_moved(driven, 2, -390.0)
    driven.until(lambda cycle: cycle.joints)
    driven.arm.power(False)
    _comes_back_moved(driven, 2, -410.0)
    driven.until(lambda cycle: cycle.joints)


def test_a_servo_whose_power_went_with_the_port_is_a_fault_before_it_gets_a_goal(
    driven: Driven,
) -> None:
    driven.send(shoulder=0.9)
    driven.cycles(3)
    driven.emulator.unplug()
    driven.until(lambda _: driven.arm.bus is None)
    driven.emulator.power_cycle(1)
    driven.emulator.start()
    driven.until(lambda cycle: cycle.joints)
    driven.becomes(FollowerState.FAULT)
    assert driven.emulator.torques_on() == {1: False, 2: True}


def test_a_servo_without_torque_gets_no_goal_where_the_port_is_back_at_once(
    driven: Driven, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unplugged(*_: object) -> None:
        raise BusUnplugged

    driven.send(shoulder=0.9)
    driven.cycles(3)
    monkeypatch.setattr(driven.arm.bus, "write_goal", unplugged)
    driven.until(lambda _: driven.arm.bus is None)
    driven.emulator.power_cycle(1)
    driven.becomes(FollowerState.FAULT)
    assert driven.emulator.torques_on() == {1: False, 2: True}


def _miss_fault(driven: Driven) -> None:
    """No servo hears the goals of a fault; then none answers."""
    _run_away(driven)
    driven.emulator.loses = lambda: True
    _overheat(driven, 2)
    driven.becomes(FollowerState.FAULT)
    driven.until(lambda cycle: "have not confirmed" in cycle.trouble)
    driven.emulator.faults.silent |= {1, 2}
    driven.cycles(2)


def test_a_servo_that_missed_a_faults_goal_is_held_when_it_answers_again(driven: Driven) -> None:
    _miss_fault(driven)
    driven.emulator.loses = None
    driven.emulator.faults.silent.clear()
    each = driven.emulator.each
    driven.until(lambda _: each(lambda motor: abs(motor.goal - motor.position) < 1.0)[1])


def test_a_servo_that_was_not_heard_at_a_fault_is_held_once_it_answers_and_is_driven(
    driven: Driven,
) -> None:
    """It has no goal of the fault, and goes on to the last one that it heard."""
    emulator = driven.emulator
    _run_away(driven)
    emulator.faults.silent.add(1)
    _overheat(driven, 2)
    driven.becomes(FollowerState.FAULT)
    for torque in (False, True):
        with emulator.motor(1) as motor:
            motor.torque_on = torque
        emulator.faults.silent.clear()
        driven.until(lambda cycle: cycle.joints)
        driven.cycles(5)
    each = emulator.each
    driven.until(lambda _: each(lambda motor: abs(motor.goal - motor.position) < 1.0)[1])
    assert set(emulator.torques_on().values()) == {True}


@pytest.mark.parametrize("turned", [-300.0, -4096.0])
def test_a_goal_of_a_fault_that_was_missed_wakes_no_servo_whose_power_is_back(
    driven: Driven, turned: float
) -> None:
    emulator = driven.emulator
    _miss_fault(driven)
    emulator.power_cycle(1)
    driven.turn_by_hand(turned)
    stands = emulator.positions()
    emulator.loses = None
    emulator.faults.silent.clear()
    driven.cycles(30)
    assert emulator.positions() == pytest.approx(stands, abs=1.0)
    assert emulator.torques_on() == {1: False, 2: True}


@pytest.mark.parametrize("stopped", ["in a fault", "silent", "by an emergency stop", "deactivated"])
def test_a_servo_that_lost_count_of_its_turns_is_not_driven_on(
    driven: Driven, stopped: str
) -> None:
    """A whole turn without power; it may come back, unless the power went under torque."""
    driven.send(shoulder=0.9)
    driven.becomes(FollowerState.HOLDING)
    arm, torques = driven.arm, driven.emulator.torques_on
    if stopped == "in a fault":
        driven.emulator.faults.silent.add(1)
        driven.becomes(FollowerState.FAULT)
        driven.emulator.faults.silent.clear()
    elif stopped == "silent":
        driven.emulator.faults.silent.add(1)
        driven.cycles(1)
        with pytest.raises(IncompleteReply):
            arm.estop()
        driven.emulator.faults.silent.clear()
        driven.until(lambda _: not arm.owing_off)
    elif stopped == "by an emergency stop":
        arm.estop()
    else:
        arm.power(False)
    driven.emulator.power_cycle(1)
    driven.turn_by_hand(-4096.0)
    driven.cycles(20)
    for switch in (lambda: arm.release(time.monotonic()), lambda: arm.power(True)):
        with pytest.raises(JobError, match="shoulder may have lost count of its servo's turns"):
            switch()
        assert not torques()[1]
    driven.turn_by_hand(4096.0)
    driven.cycles(20)
    if stopped in ("in a fault", "silent"):
        with pytest.raises(JobError, match="shoulder may have lost count of its servo's turns"):
            arm.release(time.monotonic())
        assert not torques()[1]
    else:
        arm.release(time.monotonic())
        assert set(torques().values()) == {True}


@pytest.mark.parametrize(("boom", "counts"), [(HORN, False), (RACK, True)])
def test_a_servo_on_a_joint_goes_on_after_it_lost_its_power_and_a_geared_one_does_not(
    tmp_path: Path, boom: str, counts: bool
) -> None:
    with driven_arm("feetech", tmp_path, boom) as driven:
        driven.emulator.power_cycle(2)
        driven.becomes(FollowerState.FAULT)
        said = pytest.raises(JobError, match="boom may have lost count")
        with said if counts else nullcontext():
            driven.arm.release(time.monotonic())
        assert driven.emulator.torques_on()[2] is not counts


def test_a_joint_that_a_hand_moves_while_it_is_read_keeps_its_count(driven: Driven) -> None:
    """Farther than half a turn of its servo."""
    driven.send(shoulder=0.9)
    driven.becomes(FollowerState.HOLDING)
    driven.arm.estop()
    for _ in range(9):
        driven.turn_by_hand(-280.0)
        driven.until(lambda cycle: cycle.joints)
    driven.arm.release(time.monotonic())
    assert set(driven.emulator.torques_on().values()) == {True}


@pytest.mark.parametrize(("boom", "counts"), [(HORN, False), (RACK, True)])
def test_a_geared_servo_that_passed_its_encoders_jump_without_torque_is_not_driven_on(
    tmp_path: Path, boom: str, counts: bool
) -> None:
    with driven_arm("feetech", tmp_path, boom) as driven:
        arm, emulator = driven.arm, driven.emulator
        driven.cycles(3)
        arm.estop()
        steps = int((4096.0 - emulator.positions()[2]) // 300.0) + 2

        def turn(by: float) -> None:
            for _ in range(steps):
                emulator.push(2, emulator.positions()[2] + by)
                driven.until(lambda cycle: cycle.joints)

        turn(300.0)
        said = pytest.raises(JobError, match="boom may have lost count")
        with said if counts else nullcontext():
            arm.release(time.monotonic())
        assert set(emulator.torques_on().values()) == {not counts}
        arm.estop()
        turn(-300.0)
        arm.release(time.monotonic())
        driven.send(boom=0.05)


def test_a_geared_servo_pushed_past_its_encoders_jump_under_torque_is_not_driven_on(
    tmp_path: Path,
) -> None:
    with driven_arm("feetech", tmp_path) as driven:
        driven.cycles(3)
        with driven.emulator.motor(2) as motor:
            motor.turn(1400.0)
            motor.goal = motor.position
        driven.until(lambda _: driven.arm.follower.is_fresh(time.monotonic()))
        with pytest.raises(JobError, match="boom may have lost count"):
            driven.send(boom=0.05)
        with pytest.raises(JobError, match="boom may have lost count"):
            driven.arm.release(time.monotonic())


def test_a_servo_that_let_go_with_an_alarm_has_not_lost_count(driven: Driven) -> None:
    with driven.emulator.motor(1) as motor:
        motor.alarms.add("overload")
        motor.torque_on = False
    driven.becomes(FollowerState.FAULT)
    driven.cycles(60)
    with pytest.raises(JobError) as caught:
        driven.arm.release(time.monotonic())
    assert "lost count" not in str(caught.value)
    driven.emulator.power_cycle(1)
    driven.cycles(60)
    with pytest.raises(JobError, match="lost count"):
        driven.arm.release(time.monotonic())


def test_an_emergency_stop_does_not_hide_that_a_servo_lost_its_power(driven: Driven) -> None:
    driven.emulator.power_cycle(1)
    driven.becomes(FollowerState.FAULT)
    driven.arm.estop()
    with pytest.raises(JobError, match="lost count"):
        driven.arm.release(time.monotonic())


def test_a_servo_that_is_silent_while_its_torque_is_off_has_not_lost_count(driven: Driven) -> None:
    arm, silent = driven.arm, driven.emulator.faults.silent
    arm.estop()
    driven.cycles(60)
    silent.add(1)
    driven.cycles(1)
    with pytest.raises(IncompleteReply):
        arm.power(False)
    silent.clear()
    driven.until(lambda cycle: cycle.joints and not arm.owing_off)
    arm.release(time.monotonic())
    arm.estop()
    arm.release(time.monotonic())


def test_a_servo_that_was_without_power_is_a_fault_before_it_gets_a_goal(driven: Driven) -> None:
    """A goal would switch it on again, and it would jump back from where it sank to."""
    driven.send(shoulder=0.5)
    driven.becomes(FollowerState.HOLDING)
    driven.emulator.faults.silent.add(1)
    driven.cycles(3)
    driven.emulator.power_cycle(1)
    driven.turn_by_hand(-300.0)
    sunk = driven.emulator.positions()[1]
    driven.emulator.faults.silent.clear()
    driven.becomes(FollowerState.FAULT)
    driven.cycles(50)
    assert driven.emulator.positions()[1] == pytest.approx(sunk, abs=10.0)
    assert driven.emulator.torques_on() == {1: False, 2: True}


def test_a_servo_without_torque_is_a_fault_before_the_first_move_too(driven: Driven) -> None:
    driven.cycles(3)
    driven.emulator.power_cycle(1)
    driven.becomes(FollowerState.FAULT)
