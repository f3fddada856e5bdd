"""A doubt about a servo's turns outlasts the driver's process, and ends by a person's word."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

import driver_rig as support
from driver_rig import Rig, driver_rig
from lifecycle_msgs.msg import Transition
from std_srvs.srv import Trigger
from stops_bench import StoppedArm

from longarm_comp.devices.follower_report import FollowerState
from longarm_comp.devices.kept_turns import TURNS, KeptTurns
from longarm_comp.devices.servo_watch import JointFault, ServoTrouble
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.share import folder
from longarm_interfaces.msg import DriverState

TURN = 4096.0
LOST = "shoulder may have lost count of servo turns"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with driver_rig(tmp_path_factory.mktemp("doubt")) as made:
        yield made


@pytest.fixture(scope="module")
def counting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """An arm of which no count was lost, unlike that of `rig`."""
    with driver_rig(tmp_path_factory.mktemp("counting")) as made:
        yield made


def turned_without_torque(rig: Rig) -> None:
    """The servo's power went and came back a turn away, and the driver says so."""
    rig.in_order().is_in(DriverState.READY)
    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    rig.stage.spin(rig.free)
    rig.emulator.power_cycle(1)
    rig.emulator.push(1, rig.emulator.positions()[1] - TURN)
    assert LOST in rig.is_in(DriverState.FAULT).message


@pytest.mark.parametrize("ended", ["killed", "stopped"])
def test_a_lost_count_is_no_less_lost_after_a_restart(rig: Rig, ended: str) -> None:
    turned_without_torque(rig)
    if ended == "killed":
        rig.keeps_a_fault()
        rig.dies()
    else:
        rig.ends()
    rig.start()
    assert LOST in rig.is_in(DriverState.FAULT).message
    rig.rests()
    assert rig.free()
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_in(DriverState.READY)
    assert rig.driving()


def test_a_lost_count_ends_when_the_driver_is_configured_again_and_reset(rig: Rig) -> None:
    turned_without_torque(rig)
    assert rig.change(Transition.TRANSITION_ACTIVATE)
    answer = rig.call(graph.RESET, Trigger.Request())
    assert not answer.success and "configure the driver again and reset it" in answer.message
    for transition in ("DEACTIVATE", "CLEANUP", "CONFIGURE", "ACTIVATE"):
        assert rig.change(getattr(Transition, f"TRANSITION_{transition}"))
    assert LOST in rig.is_in(DriverState.FAULT).message and rig.free()
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_in(DriverState.READY)
    assert rig.driving()


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """An arm whose shoulder goes into the second turn of its servo."""
    with pytest.MonkeyPatch.context() as patch:
        text = support.CONFIG.replace("zero_ticks: 2048.0", "zero_ticks: 3500.0")
        patch.setattr(support, "CONFIG", text)
        with driver_rig(tmp_path_factory.mktemp("far")) as made:
            yield made


@pytest.mark.parametrize("ended", ["killed", "stopped", "silent"])
def test_a_count_that_was_lost_while_no_driver_ran_is_a_fault(far: Rig, ended: str) -> None:
    """It reads in the turn of power-on, which it had left."""

    def away() -> frozenset[str]:
        return KeptTurns(state_folder(), "", str(far.link), ("shoulder", "boom")).away

    far.in_order().goes(shoulder=0.9)
    for lost in (False, True):
        far.stage.spin(lambda: away() == {"shoulder"})
        if ended == "silent":
            far.emulator.faults.silent |= {1, 2}
        far.process.send_signal(signal.SIGKILL if ended == "killed" else signal.SIGINT)
        assert far.process.wait(timeout=300) == {"killed": -9, "stopped": 0, "silent": 3}[ended]
        if lost:
            far.emulator.power_cycle(1)
            with far.emulator.motor(1) as motor:
                motor.seen -= TURN
        far.emulator.faults.silent.clear()
        far.start()
        if not lost:
            far.is_in(DriverState.READY)
    assert LOST in far.is_in(DriverState.FAULT).message
    far.stage.spin(lambda: not away())
    far.rests()
    assert not far.emulator.torques_on()[1]
    assert far.call(graph.RESET, Trigger.Request()).success
    far.is_in(DriverState.READY)
    assert far.driving()
    far.ends()
    with far.emulator.motor(1) as motor:
        motor.seen = motor.position
    far.start()


@pytest.mark.parametrize("alarm", ["overload", "overheat", "hot", "voltage", "silent"])
def test_to_start_the_driver_again_ends_no_fault_but_that_of_power_switched_off(
    counting: Rig, alarm: str
) -> None:
    counting.in_order().goes(shoulder=0.1)  # from then on silence is a fault
    silent = counting.emulator.faults.silent
    with counting.emulator.motor(1) as motor:
        if alarm == "hot":
            motor.temperature_c = 68.0
        elif alarm == "silent":
            silent |= {1, 2}
        else:
            motor.alarms.add(alarm)
    told = counting.is_in(DriverState.FAULT).message
    if alarm not in ("voltage", "silent"):
        counting.keeps_a_fault()
    counting.dies()
    counting.emulator.unplug()
    silent.clear()
    with counting.emulator.motor(1) as motor:
        motor.alarms.clear()
        motor.temperature_c = 30.0
    counting.emulator.start()
    counting.start()
    if alarm in ("voltage", "silent"):
        counting.is_in(DriverState.READY)
        return
    said = counting.is_in(DriverState.FAULT).message
    assert "fault since" in said and told.partition(";")[0].partition("shoulder")[2] in said
    assert counting.call(graph.RESET, Trigger.Request()).success
    counting.is_in(DriverState.READY)


def test_the_end_of_an_emergency_stop_switches_no_torque_on_while_a_fault_is_kept(
    driver: StoppedArm,
) -> None:
    driver.stops.keep_fault(JointFault(ServoTrouble.STALLED, "a", "against something"))
    assert driver.ask(graph.ESTOP, True).success and driver.on == {False}
    assert driver.ask(graph.ESTOP, False).success
    assert driver.on == {False} and "stalled" in driver.stops.standing
    assert driver.ask(graph.RESET).success and driver.on == {True}


def test_a_reset_does_not_end_a_doubt_of_an_arm_whose_torque_is_on(driver: StoppedArm) -> None:
    """Its encoder was pushed past the place where it jumps."""
    assert driver.arm is not None
    driver.arm._counts.lose({1})
    driver.stops.keep_doubt(driver.arm.doubt)
    answer = driver.ask(graph.RESET)
    assert not answer.success and "configure the driver again and reset it" in answer.message
    assert "a may have lost count" in driver.stops.standing and driver.on == {True}


def test_a_doubt_is_kept_beside_a_fault_and_asked_for_once(driver: StoppedArm) -> None:
    driver.stops.keep_fault(JointFault(ServoTrouble.LET_GO, "a", "its torque is off"))
    for _ in range(3):
        driver.stops.keep_doubt("")
        driver.stops.keep_doubt("a may have lost count")
    said = driver.stops.standing
    assert said.count("a may have lost count") == 1 and "its torque is off" in said


def test_what_the_servos_counted_is_forgotten_only_once_the_doubt_about_it_is_kept(
    driver: StoppedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(file: object) -> None:
        raise OSError(28, "full")

    stops, arm = driver.stops, driver.arm
    assert arm is not None
    arm._counts.away = frozenset("a")
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", fails)
        arm._counts.lose({1})
        stops.keep_turns(arm)
        driver.stage.spin(lambda: stops.unkept)
        stops.keep_turns(arm)
        assert not stops.away
    driver.stage.spin(lambda: not stops.unkept)
    stops.keep_turns(arm)
    assert stops.away == {"a"}


def test_an_arm_whose_turns_cannot_be_kept_is_held_and_it_is_said(
    driver: StoppedArm, tmp_path: Path
) -> None:
    stops, arm, folder = driver.stops, driver.arm, tmp_path / "stops" / TURNS
    assert arm is not None
    folder.write_text("a file where the folder should be")
    driver.moves()
    arm._counts.away = frozenset("a")
    driver.cycles(lambda: stops.keep_turns(arm) or stops.standing)
    assert "turns cannot be kept" in stops.standing and str(folder) in stops.standing
    assert driver.told[-1][0] and stops.state[0] == DriverState.HOLDING
    driver.cycles(lambda: arm.follower.state is FollowerState.HOLDING)
    assert driver.on == {True}
    folder.unlink()
    driver.cycles(lambda: stops.keep_turns(arm) or not stops._turns.trouble)
    assert stops.standing and driver.ask(graph.RESET).success
    stops.keep_turns(arm)
    assert not stops.standing


def test_simulated_servos_have_counted_no_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    up = BringUp(arm=folder("config") / "arm_demo.yaml", sim=True)
    file = Path(up.parameters("servo_driver", "bus")["state"]) / TURNS / "arm.txt"
    file.parent.mkdir(parents=True)
    file.touch()
    up.commands(tmp_path)
    assert not file.exists()
