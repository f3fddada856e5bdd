"""The whole servo side without ROS: configuration, follower and bus against emulated servos."""

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from driven_arm import MODEL, Driven, driven_arm

from longarm_comp.core.errors import JobError
from longarm_comp.devices.follower_report import FollowerState
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_bus.state import BusUnplugged, IncompleteReply
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_watch import ServoTrouble
from longarm_comp.sim.servo_emulator.emulator import ServoEmulator
from longarm_comp.sim.servo_emulator.motor import MotorSpec


@pytest.fixture(params=sorted(MODEL))
def driven(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Driven]:
    with driven_arm(request.param, tmp_path) as made:
        yield made


def test_the_arm_goes_where_it_is_told_and_arrives_from_both_sides(driven: Driven) -> None:
    for shoulder, boom, side in ((0.9, 0.08, 1), (0.5, 0.05, -1)):
        driven.send(shoulder=shoulder, boom=boom)
        driven.becomes(FollowerState.HOLDING)
        driven.stands(shoulder=shoulder)
        assert driven.joints()["boom"] == pytest.approx(boom, abs=3e-5)
        assert driven.emulator.each(lambda motor: motor.approach) == {1: side, 2: -side}
    assert driven.troubles == []


def test_lost_and_damaged_replies_on_the_way_do_not_matter(driven: Driven) -> None:
    driven.send(shoulder=0.6)
    for k in range(12):
        driven.emulator.faults.drops[1 + k % 2] += 1
        driven.emulator.faults.corrupt[2 - k % 2] += 1
        driven.cycles(1)
    driven.becomes(FollowerState.HOLDING)
    driven.stands(shoulder=0.6)
    assert driven.troubles == []
    assert driven.arm.bus is not None and driven.arm.bus.counters.retries > 0


def test_a_servo_that_falls_silent_stops_the_arm(driven: Driven) -> None:
    driven.send(shoulder=1.0, boom=0.1)
    driven.until(lambda _: driven.joints()["shoulder"] > 0.4)
    driven.emulator.faults.silent.add(2)
    driven.becomes(FollowerState.FAULT)
    assert driven.troubles == [(ServoTrouble.SILENT, "boom")]
    time.sleep(0.3)
    assert driven.joints()["shoulder"] < 0.95
    driven.emulator.faults.silent.discard(2)
    driven.until(lambda cycle: cycle.joints)
    driven.arm.release(time.monotonic())
    driven.send(shoulder=0.3)
    driven.becomes(FollowerState.HOLDING)


def test_a_jammed_servo_is_relieved_of_its_load(driven: Driven) -> None:
    driven.send(boom=0.1)
    driven.until(lambda _: driven.joints()["boom"] > 0.04)
    with driven.emulator.motor(2) as motor:
        motor.blocked = True
    driven.becomes(FollowerState.FAULT)
    assert driven.troubles == [(ServoTrouble.STALLED, "boom")]
    driven.until(lambda cycle: cycle.joints and abs(cycle.states[2].load) < 0.05)


def test_an_overheating_servo_stops_the_arm_before_it_lets_go(driven: Driven) -> None:
    driven.send(shoulder=1.0)
    driven.cycles(1)
    with driven.emulator.motor(1) as motor:
        motor.temperature_c = 68.0  # above the joint's 65, below the servo's own 70
    driven.becomes(FollowerState.FAULT)
    assert driven.troubles == [(ServoTrouble.OVERHEATED, "shoulder")]
    assert driven.emulator.torques_on() == {1: True, 2: True}


def test_an_unplugged_bus_is_a_fault_and_the_arm_goes_on_after_release(driven: Driven) -> None:
    driven.send(shoulder=1.0)
    driven.until(lambda _: driven.joints()["shoulder"] > 0.3)
    driven.emulator.unplug()
    driven.becomes(FollowerState.FAULT)
    assert {trouble for trouble, _ in driven.troubles} == {ServoTrouble.SILENT}
    driven.emulator.start()
    driven.until(lambda cycle: cycle.joints)
    driven.arm.release(time.monotonic())
    driven.send(shoulder=0.4)
    driven.becomes(FollowerState.HOLDING)
    driven.stands(shoulder=0.4)


def test_what_moved_the_arm_before_its_torque_went_off_is_forgotten(driven: Driven) -> None:
    """Also where it stands by then: a person may have moved it."""
    driven.send(shoulder=0.9)
    driven.until(lambda cycle: cycle.joints and cycle.joints["shoulder"].position > 0.3)
    driven.arm.power(False)
    driven.cycles(20)
    driven.turn_by_hand(-300.0)
    driven.cycles(20)
    at = driven.joints()["shoulder"]
    driven.arm.power(True)
    driven.cycles(100)
    assert driven.joints()["shoulder"] == pytest.approx(at, abs=2e-3)
    assert driven.arm.follower.state is FollowerState.IDLE


def test_a_jammed_servo_stops_pushing_though_frames_are_lost(driven: Driven) -> None:
    """The goal that stops it is sent until it is read back."""
    emulator, lost = driven.emulator, iter(range(5))
    follower = driven.arm.follower
    emulator.loses = lambda: follower.state is FollowerState.FAULT and next(lost, None) is not None
    driven.send(shoulder=0.9)
    driven.until(lambda cycle: cycle.joints and cycle.joints["shoulder"].position > 0.3)
    with emulator.motor(1) as motor:
        motor.blocked = True
    driven.becomes(FollowerState.FAULT)
    driven.cycles(20)
    with emulator.motor(1) as motor:
        assert motor.goal == pytest.approx(motor.position, abs=1.0)
    assert next(lost, None) is None and all(emulator.torques_on().values())


@pytest.mark.parametrize("protocol", sorted(MODEL))
def test_a_loaded_arm_does_not_sink_when_its_driver_starts_again(protocol: str) -> None:
    """It stands in its droop, 30 ticks below its goal: a goal where it stands would lower it."""
    spec = MotorSpec(max_speed_ticks_s=6000, droop_ticks=50.0)
    at, loads = {1: 2048.0, 2: 2048.0}, {1: -0.6, 2: 0.0}
    with ServoEmulator(protocol, at, spec, loads=lambda: loads) as emulator:
        joint = {"model": MODEL[protocol], "type": "revolute", "zero_ticks": 2048.0,
                 "lower": -1.5, "upper": 1.5, "max_velocity": 3.0}  # fmt: skip
        config = ServoConfig.parse(
            {"bus": {"protocol": protocol, "port": emulator.port, "reply_timeout_s": 0.2},
             "joints": {f"j{i}": {"servo_id": i, **joint} for i in at},
             "follower": {"silence_s": 0.6}}, "here",
        )  # fmt: skip

        def rest(arm: ServoArm, **target: float) -> float:
            while not arm.cycle(time.monotonic()).joints:
                pass
            if target:
                point = TrajectoryPoint(0.0, tuple(target.values()))
                arm.accept(JointTrajectory(tuple(target), (point,)), time.monotonic())
            still, at = 0, emulator.positions()[1]
            while still < 40:  # cycles without a motion
                arm.cycle(time.monotonic())
                time.sleep(0.005)
                before, at = at, emulator.positions()[1]
                still = still + 1 if at == pytest.approx(before, abs=0.01) else 0
            return at

        arm = ServoArm(config)
        arm.power(True)
        stood = rest(arm, j1=0.5)
        assert stood == pytest.approx(config.joints["j1"].to_ticks(0.5) - 30.0, abs=2.0)
        for moves in ({}, {"j2": 0.3}):
            assert arm.bus is not None
            arm.bus.close()  # killed: the servos go on holding
            arm = ServoArm(config)
            arm.power(True)
            assert rest(arm, **moves) == pytest.approx(stood, abs=2.0)
            arm.release(time.monotonic())
            assert rest(arm) == pytest.approx(stood, abs=2.0)
        emulator.push(1, stood + 600.0)  # farther than any droop: no goal to go back to
        with emulator.motor(1) as motor:
            motor.blocked = True  # held there by hand until the driver has read it
        arm.power(True)
        assert arm.bus is not None
        assert abs(arm.bus.goals([1])[1] - config.joints["j1"].to_ticks(0.5)) > 100
        arm.close()


def test_a_servo_that_let_go_is_found_within_half_a_second_at_any_rate(driven: Driven) -> None:
    arm, now = driven.arm, time.monotonic() + 1.0
    tries = range(50)  # on a busy machine replies are missed
    assert any((looked := arm.cycle(now)).joints and not looked.trouble for _ in tries)
    driven.emulator.power_cycle(2)
    assert arm.cycle(now + 0.4).step.state is FollowerState.IDLE
    assert any(arm.cycle(now + 0.6).step.state is FollowerState.FAULT for _ in tries)


def test_what_another_servo_has_stored_is_not_rewritten_when_the_cable_is_back(
    driven: Driven,
) -> None:
    driven.emulator.unplug()
    driven.until(lambda _: driven.arm.bus is None)
    driven.emulator.start()
    with closing(driven.config.open_bus()) as bus:
        own = bus.turns([1])
        bus.set_turns({1: False})
        other = bus.turns([1])
    assert own != other
    driven.until(lambda cycle: "set for other turns" in cycle.trouble)
    with closing(driven.config.open_bus()) as bus:
        assert bus.turns([1]) == other


def test_torque_is_on_only_where_that_was_asked_for_and_nothing_speaks_against_it(
    driven: Driven,
) -> None:
    arm, emulator, until = driven.arm, driven.emulator, driven.until

    def torques() -> set[bool]:
        return set(emulator.torques_on().values())

    arm.power(False)
    until(lambda cycle: cycle.joints)
    there = JointTrajectory(("boom",), (TrajectoryPoint(0.0, (0.05,)),))
    with pytest.raises(JobError, match="torque is off"):
        arm.accept(there, time.monotonic())
    arm.power(True)
    arm.accept(there, time.monotonic())
    arm.estop()
    assert torques() == {False}
    for hot, why in ((67.0, "overheated"), (90.0, "OVERHEAT")):  # ours; the servo's own
        with emulator.motor(2) as motor:
            motor.temperature_c = hot
        until(lambda cycle, hot=hot: cycle.joints and cycle.states[2].temperature_c > hot - 2.0)
        with pytest.raises(JobError, match=why):
            arm.release(time.monotonic())
        assert torques() == {False} and not arm.powered
    with emulator.motor(2) as motor:
        motor.temperature_c = 30.0
    emulator.power_cycle(2)  # clears its alarm
    until(lambda cycle: cycle.joints and not cycle.states[2].error_flags)
    arm.release(time.monotonic())
    assert torques() == {True} and arm.powered
    arm.accept(there, time.monotonic())
    with emulator.motor(2) as motor:
        motor.temperature_c = 67.0
    driven.becomes(FollowerState.FAULT)
    with pytest.raises(JobError, match="overheated"):
        arm.release(time.monotonic())
    assert torques() == {True} and arm.powered  # a heavy arm would drop
    emulator.faults.silent.add(2)
    with pytest.raises(IncompleteReply):
        arm.estop()
    assert arm.owing_off and arm.bus is not None  # nobody knows whether it heard
    emulator.faults.silent.clear()
    until(lambda cycle: not arm.owing_off)
    emulator.unplug()
    until(lambda cycle: arm.bus is None)
    with emulator.motor(1) as one, emulator.motor(2) as two:
        one.torque_on = two.torque_on = True
    with pytest.raises(BusUnplugged):
        arm.power(False)
    with pytest.raises(BusUnplugged):
        arm.power(True)  # this was not done, so off is still owing
    assert torques() == {True}  # nobody can reach them
    emulator.start()
    until(lambda cycle: arm.bus is not None)
    assert torques() == {False}
