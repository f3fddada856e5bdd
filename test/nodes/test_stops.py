"""A stop or hold stands until it is reset: in every state of the driver, whatever happens to it."""

import itertools
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Duration
from driver_rig import Rig
from lifecycle_msgs.msg import Transition
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.orders import order_id
from longarm_interfaces.msg import DriverState, Motion

STOPS = {"estop": (graph.ESTOP, DriverState.ESTOP), "hold": (graph.HOLD, DriverState.HOLDING)}


def moving(rig: Rig) -> None:
    """On a long way: the goal stays away from both ends of the joint."""
    here = rig.joints()["shoulder"]
    way = JointTrajectory(joint_names=["shoulder"], points=[JointTrajectoryPoint()])
    way.points[0].positions = [0.9 if here < 0.3 else -0.4]
    way.points[0].time_from_start = Duration(sec=30)
    rig.stage.spin(rig.hears)
    way.header.stamp = rig.stamps.next()
    rig.trajectories.publish(way)
    rig.stage.spin(lambda: rig.events(order_id(way)) == [Motion.ACCEPTED])
    rig.is_in(DriverState.MOVING)
    rig.stage.spin(lambda: abs(rig.joints()["shoulder"] - here) > 0.01)


def waiting(rig: Rig) -> None:
    """A driver was killed, so the servos hold; the next one finds no cable."""
    rig.dies()
    rig.emulator.unplug()
    rig.start(patience_s=60.0)
    rig.is_in(DriverState.UNCONFIGURED)
    assert rig.driving()


def in_fault(rig: Rig) -> None:
    with rig.emulator.motor(1) as motor:
        motor.blocked = True
    rig.send("blocked", shoulder=0.9 if rig.joints()["shoulder"] < 0.3 else -0.4)
    rig.is_in(DriverState.FAULT)
    with rig.emulator.motor(1) as motor:
        motor.blocked = False


def inactive(rig: Rig) -> None:
    assert rig.change(Transition.TRANSITION_DEACTIVATE)
    rig.is_in(DriverState.INACTIVE)


def unconfigured(rig: Rig) -> None:
    inactive(rig)
    assert rig.change(Transition.TRANSITION_CLEANUP)
    rig.is_in(DriverState.UNCONFIGURED)


def finalized(rig: Rig) -> None:
    assert rig.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    rig.is_in(DriverState.UNCONFIGURED)


STATES: dict[str, Callable[[Rig], object]] = {
    "ready": lambda rig: rig.is_in(DriverState.READY),
    **{made.__name__: made for made in (moving, in_fault, waiting, inactive, unconfigured)},
    finalized.__name__: finalized,
}


def restarted(rig: Rig) -> None:
    owing = rig.said and "not every servo confirms it" in rig.said[-1].message
    rig.process.send_signal(signal.SIGINT)
    assert rig.process.wait(timeout=300) == (3 if owing else 0)
    rig.start()


def unplugged(rig: Rig) -> None:
    rig.emulator.unplug()
    del rig.diagnostics[:]
    rig.stage.spin(lambda: rig.told("servo bus") not in ("", "every servo answers"))


def frozen(rig: Rig) -> None:
    """It hangs, and a trajectory comes meanwhile."""
    rig.process.send_signal(signal.SIGSTOP)
    state = Path(f"/proc/{rig.process.pid}/stat")
    rig.stage.spin(lambda: state.read_text().rpartition(")")[2].split()[0] == "T")
    rig.send("meanwhile", shoulder=0.25)
    rig.process.send_signal(signal.SIGCONT)
    del rig.said[:]


EVENTS = {made.__name__: made for made in (Rig.killed, restarted, unplugged, frozen)}

USUAL = {
    ("ready", "estop", "killed"), ("moving", "hold", "killed"), ("in_fault", "estop", "restarted"),
    ("waiting", "estop", "unplugged"), ("waiting", "hold", "killed"),
    ("inactive", "estop", "frozen"), ("unconfigured", "hold", "unplugged"),
    ("finalized", "estop", "killed"), ("ready", "hold", "restarted"),
    ("moving", "estop", "unplugged"),
}  # fmt: skip
CASES = [
    pytest.param(*case, id="-".join(case), marks=() if case in USUAL else pytest.mark.long)
    for case in itertools.product(STATES, STOPS, EVENTS)
]


@pytest.mark.parametrize(("state", "stop", "event"), CASES)
def test_no_motion_until_reset(fresh: Rig, state: str, stop: str, event: str) -> None:
    rig, (service, told) = fresh, STOPS[stop]
    STATES[state](rig)
    answer = rig.call(service, SetBool.Request(data=True))
    assert answer.success or (state == "waiting" and stop == "estop")  # not one servo answers
    if state in ("ready", "moving", "in_fault", "inactive"):  # it reads the servos
        rig.rests()
    stood, on = rig.joints(), rig.driving()
    EVENTS[event](rig)
    rig.emulator.unplug()
    rig.emulator.start()
    anew = event in ("killed", "restarted")
    if anew or state not in ("unconfigured", "finalized"):
        rig.stage.spin(lambda: rig.told("servo bus") == "every servo answers")

    def says() -> bool:
        """That it is stopped; a hold may have ended in a fault, where readings failed."""
        said = rig.said[-1] if rig.said else DriverState()
        faulty = stop == "hold" and said.state == DriverState.FAULT
        return f"~/{stop}" in said.message and (said.state == told or faulty)

    rig.stage.spin(says)
    rig.refuses(f"~/{stop}")
    assert says()
    if stop == "estop":
        rig.stage.spin(rig.free)
    else:
        let_go = event == "restarted" and state != "waiting"  # an end that reaches the servos
        assert rig.driving() == (on and not let_go)  # it neither drops nor is armed
    assert rig.joints() == pytest.approx(stood, abs=1e-3)

    assert rig.call(graph.RESET, Trigger.Request()).success
    if anew or state not in ("inactive", "unconfigured", "finalized"):
        rig.is_in(DriverState.READY)
        rig.is_idle()
        rig.goes(shoulder=0.25)
    else:
        rig.stage.spin(lambda: not says())
        assert rig.said[-1].state in (DriverState.INACTIVE, DriverState.UNCONFIGURED)
        assert rig.free()


def test_reset_switches_no_torque_on_unless_the_driver_is_active(fresh: Rig) -> None:
    rig = fresh
    inactive(rig)
    for _ in range(2):  # without a stop, then with one
        assert rig.call(graph.RESET, Trigger.Request()).success
        assert rig.call(graph.ESTOP, SetBool.Request(data=False)).success
        rig.is_in(DriverState.INACTIVE)
        assert rig.free()
        for service, _ in STOPS.values():
            assert rig.call(service, SetBool.Request(data=True)).success
    assert rig.change(Transition.TRANSITION_ACTIVATE)
    rig.is_in(DriverState.ESTOP)
    assert rig.free()
    for on in (False, True):
        assert "emergency stop" in rig.call(graph.HOLD, SetBool.Request(data=on)).message
        assert rig.free()
    assert "held" in rig.call(graph.ESTOP, SetBool.Request(data=False)).message
    assert rig.free()  # as it was when it was stopped
    rig.refuses("~/hold")
    assert rig.call(graph.HOLD, SetBool.Request(data=False)).message == "ready"
    rig.goes(shoulder=0.25)
    unconfigured(rig)
    answer = rig.call(graph.RESET, Trigger.Request())
    assert answer.success and "not configured" in answer.message
    for joint in rig.arm.joints:
        with rig.emulator.motor(joint.servo_id) as motor:
            motor.switch(True)
    answer = rig.call(graph.ESTOP, SetBool.Request(data=True))
    assert answer.success and rig.free()  # also where no driver has configured them
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_in(DriverState.UNCONFIGURED)
    assert rig.free()


def test_a_hold_alone_switches_no_torque_on_until_it_ends(fresh: Rig) -> None:
    rig = fresh
    inactive(rig)
    ends = {graph.HOLD: SetBool.Request(data=False), graph.RESET: Trigger.Request()}
    for service, ending in ends.items():
        answer = rig.call(graph.HOLD, SetBool.Request(data=True))
        assert answer.success and "no torque" in answer.message
        assert "not active" in rig.call(service, ending).message
        assert rig.free()
    assert rig.call(graph.HOLD, SetBool.Request(data=True)).success
    assert rig.change(Transition.TRANSITION_ACTIVATE)
    rig.is_in(DriverState.HOLDING)
    assert rig.free()
    assert rig.call(graph.HOLD, SetBool.Request(data=False)).message == "ready"
    assert rig.driving()
    rig.goes(shoulder=0.25)


def test_an_arm_that_is_only_held_is_driven_on_as_it_is(fresh: Rig) -> None:
    """A load has pushed it off its goal: that must not become the new goal, or it sinks."""
    rig = fresh
    with rig.emulator.motor(1) as motor:
        motor.blocked, goal = True, motor.goal
        motor.turn(8.0)
    assert rig.call(graph.HOLD, SetBool.Request(data=True)).success
    rig.is_in(DriverState.HOLDING)
    assert rig.call(graph.RESET, Trigger.Request()).message in ("ready", "moving")
    rig.is_in(DriverState.READY)
    with rig.emulator.motor(1) as motor:
        assert (motor.goal, motor.torque_on) == (goal, True)
