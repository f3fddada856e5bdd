"""Torque off that a servo has not confirmed is owed until it has, whatever the driver does."""

import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from driver_rig import Rig
from lifecycle_msgs.msg import Transition
from std_srvs.srv import SetBool, Trigger
from stops_bench import StoppedArm

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.stops import Stops
from longarm_interfaces.msg import DriverState

UNCONFIRMED = "torque off: not every servo confirms it"


def deaf(driver: StoppedArm) -> None:
    driver.emulator.loses = lambda: True


def test_what_a_closed_arm_owes_is_sent_until_it_is_confirmed(driver: StoppedArm) -> None:
    assert driver.arm is not None
    deaf(driver)
    why = driver.arm.close()
    assert "did not answer" in why and driver.on == {True}
    driver.arm = None
    driver.stops.owe_off(bool(why))
    assert driver.stops.owed == UNCONFIRMED
    driver.emulator.loses = None
    driver.stage.spin(lambda: driver.on == {False})
    driver.stage.spin(lambda: not driver.stops.owed)


def test_a_closed_arm_that_all_servos_heard_owes_nothing(driver: StoppedArm) -> None:
    assert driver.arm is not None
    lost = [True] * (1 + driver.config.bus.retries)  # the first of three attempts
    driver.emulator.loses = lambda: bool(lost) and lost.pop()
    assert not driver.arm.close() and driver.on == {False}


def test_an_emergency_stop_without_an_arm_is_sent_until_it_is_confirmed(
    driver: StoppedArm,
) -> None:
    assert driver.arm is not None
    driver.arm.leave()
    driver.arm = None
    deaf(driver)
    answer = driver.ask(graph.ESTOP, True)
    assert not answer.success and UNCONFIRMED in answer.message and driver.on == {True}
    driver.emulator.loses = None
    driver.stage.spin(lambda: driver.on == {False})
    driver.stage.spin(lambda: not driver.stops.owed)
    assert driver.stops.state[1].endswith("torque is off")
    with driver.emulator.motor(1) as motor:
        motor.switch(True)
    assert driver.ask(graph.ESTOP, True).success and driver.on == {False}


def test_a_driver_that_finds_an_emergency_stop_lets_go_before_it_is_configured(
    driver: StoppedArm, tmp_path: Path
) -> None:
    assert driver.arm is not None
    assert driver.ask(graph.ESTOP, True).success
    driver.arm.leave()
    driver.arm = None
    with driver.emulator.motor(1) as motor:
        motor.switch(True)
    folder = str(tmp_path / "stops")
    Stops(driver.stage.node, driver, folder, "", driver.config, driver.fresh)
    driver.stage.spin(lambda: driver.on == {False})


def test_a_held_arm_tells_that_it_is_still_to_let_go(driver: StoppedArm) -> None:
    assert driver.arm is not None
    assert driver.ask(graph.HOLD, True).success
    deaf(driver)
    unconfirmed, driver.arm = driver.arm.close(), None
    driver.stops.owe_off(bool(unconfirmed))
    assert UNCONFIRMED in driver.stops.state[1]


def test_a_driver_tells_that_servos_may_be_on_and_lets_go_as_soon_as_they_hear(rig: Rig) -> None:
    process = rig.process
    rig.emulator.unplug()
    rig.stage.spin(lambda: "unplugged" in rig.told("servo bus"))
    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    assert rig.change(Transition.TRANSITION_CLEANUP)
    # Nobody knows whether the silent servos had power: their turns are in doubt
    rig.stage.spin(lambda: UNCONFIRMED in rig.is_in(DriverState.FAULT).message)
    assert UNCONFIRMED in rig.stage.output(process) and rig.driving()
    rig.emulator.start()
    rig.stage.spin(rig.free)
    rig.stage.spin(lambda: UNCONFIRMED not in rig.is_in(DriverState.FAULT).message)
    assert rig.change(Transition.TRANSITION_CONFIGURE)
    assert rig.change(Transition.TRANSITION_ACTIVATE)
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_idle()
    assert rig.call(graph.HOLD, SetBool.Request(data=True)).success
    assert rig.call(graph.HOLD, SetBool.Request(data=False)).success and rig.driving()

    rig.emulator.unplug()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=300) == 3
    rig.stage.spin(lambda: f"has ended; {UNCONFIRMED}" in rig.said[-1].message)
    rig.emulator.start()
    rig.start()
    rig.is_idle()
