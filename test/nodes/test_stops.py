"""A stop or hold stands until it is reset: in every state of the driver, whatever happens to it."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from builtin_interfaces.msg import Duration
from cli_shell import Shell
from driver_rig import Rig
from lifecycle_msgs.msg import Transition
from simulated_graph import forked_graph
from std_srvs.srv import SetBool, Trigger
from target_requests import request
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.jobs.client import ArmClient, DriverStopped
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp, running
from longarm_comp.nodes.orders import order_id
from longarm_comp.share import folder
from longarm_interfaces.msg import DriverState, Motion

DEMO = folder("config") / "arm_demo.yaml"
STOPS = {"estop": (graph.ESTOP, DriverState.ESTOP), "hold": (graph.HOLD, DriverState.HOLDING)}


@pytest.fixture
def fresh(running_driver: Rig) -> Rig:
    """The rig with a new driver that nobody has stopped, ready."""
    rig = running_driver
    if rig.process.poll() is None:
        rig.stage.spin(lambda: rig.said)  # from then on it hears a signal
        rig.process.send_signal(signal.SIGINT)
        assert rig.process.wait(timeout=300) == 0
    rig.emulator.unplug()
    shutil.rmtree(state_folder(), ignore_errors=True)
    with rig.emulator.motor(1) as motor:
        motor.blocked = False
    rig.emulator.start()
    rig.start()
    rig.in_order().is_in(DriverState.READY)
    rig.goes(shoulder=0.2)  # so it hears trajectories
    return rig


def moving(rig: Rig) -> None:
    """On a long way: the goal stays away from both ends of the joint."""
    here = rig.joints()["shoulder"]
    way = JointTrajectory(joint_names=["shoulder"], points=[JointTrajectoryPoint()])
    way.points[0].positions = [0.9 if here < 0.3 else -0.4]
    way.points[0].time_from_start = Duration(sec=30)
    rig.stage.connected(rig.trajectories)
    way.header.stamp = rig.stamps.next()
    rig.trajectories.publish(way)
    rig.stage.spin(lambda: rig.events(order_id(way)) == [Motion.ACCEPTED])
    rig.is_in(DriverState.MOVING)
    rig.stage.spin(lambda: abs(rig.joints()["shoulder"] - here) > 0.01)


def waiting(rig: Rig) -> None:
    """A driver was killed, so the servos hold; the next one finds no cable."""
    rig.process.kill()
    rig.process.wait(timeout=300)
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


def killed(rig: Rig) -> None:
    rig.process.kill()
    rig.process.wait(timeout=300)
    rig.start()


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


EVENTS = {made.__name__: made for made in (killed, restarted, unplugged, frozen)}

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


def is_refused(rig: Rig, word: str) -> None:
    """Send trajectories until the driver, whose subscription may be connecting, has refused one."""
    sent: list[str] = []

    def refused() -> bool:
        told = [motion for name in sent for motion in rig.told_of(name)]
        assert all(motion.event == Motion.REFUSED for motion in told)
        return bool(told) and all(word in motion.message for motion in told)

    for _ in range(300):
        sent.append(rig.send(shoulder=0.25))
        try:
            rig.stage.spin(refused, within=1.0)
        except AssertionError:
            continue
        return
    raise AssertionError(f"nothing was refused for {word}\n{rig.stage.state()}")


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
    is_refused(rig, f"~/{stop}")
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
    is_refused(rig, "~/hold")
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


def test_a_reset_that_fails_leaves_the_stop_in_force(fresh: Rig) -> None:
    rig = fresh
    rig.emulator.unplug()
    answer = rig.call(graph.ESTOP, SetBool.Request(data=True))
    assert "not every servo confirms it" in answer.message and rig.driving()
    answer = rig.call(graph.RESET, Trigger.Request())
    assert not answer.success and "port" in answer.message
    killed(rig)
    rig.is_in(DriverState.ESTOP)
    rig.emulator.start()
    rig.stage.spin(rig.free)
    is_refused(rig, "~/estop")


def test_a_stop_frees_every_servo_that_hears_though_a_new_driver_finds_one_silent(
    fresh: Rig,
) -> None:
    """The driver died and cannot be configured; a person is caught."""
    rig = fresh
    rig.process.kill()
    rig.process.wait(timeout=300)
    rig.emulator.faults.silent.add(2)
    rig.start()
    rig.is_in(DriverState.UNCONFIGURED)
    assert rig.driving()
    answer = rig.call(graph.ESTOP, SetBool.Request(data=True))
    assert not answer.success and "not every servo confirms it" in answer.message
    rig.stage.spin(rig.free)
    assert "not every servo confirms it" in rig.is_in(DriverState.ESTOP).message
    rig.emulator.faults.silent.clear()
    rig.stage.spin(lambda: "torque is off" in rig.said[-1].message)
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_in(DriverState.READY)

    rig.emulator.unplug()  # the stop reaches no servo, and the driver dies
    assert not rig.call(graph.ESTOP, SetBool.Request(data=True)).success
    rig.process.kill()
    rig.process.wait(timeout=300)
    rig.emulator.faults.silent.add(2)
    rig.emulator.start()
    assert rig.driving()
    rig.start()
    rig.stage.spin(rig.free)
    rig.emulator.faults.silent.clear()


def test_where_no_stop_can_be_kept_the_arm_is_held_and_it_is_said(
    fresh: Rig, tmp_path: Path
) -> None:
    rig = fresh
    assert rig.driving()
    rig.process.kill()
    rig.process.wait(timeout=300)
    state = tmp_path / "state"
    state.write_text("a file where the folder should be")
    rig.start(state=state)
    said = rig.is_in(DriverState.HOLDING).message
    assert "stops cannot be kept" in said and str(state) in said
    assert rig.driving()  # it does not drop
    is_refused(rig, str(state))
    answer = rig.call(graph.RESET, Trigger.Request())
    assert not answer.success and str(state) in answer.message
    answer = rig.call(graph.ESTOP, SetBool.Request(data=True))
    assert answer.success and "ends with the driver" in answer.message and rig.free()
    rig.is_in(DriverState.ESTOP)
    state.unlink()
    rig.stage.spin(lambda: "ends with" not in rig.said[-1].message)  # written as soon as it can be
    rig.process.kill()
    rig.process.wait(timeout=300)
    rig.start(state=state)
    rig.is_in(DriverState.ESTOP)
    assert rig.call(graph.RESET, Trigger.Request()).success
    rig.is_in(DriverState.READY)
    second = rig.stage.python(
        [*("-m", "longarm_comp.nodes.servo_driver", "--ros-args"),
         *("--params-file", str(rig.file), "-p", "state:=beside/me")]
    )  # fmt: skip
    assert second.wait(timeout=300) == 2 and "an absolute path" in rig.stage.output(second)


def test_a_simulated_graph_stays_stopped_when_it_dies_and_when_it_is_started_anew(
    ros_domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shell, arm = Shell(tmp_path, capsys), Arm.load(DEMO)
    up = BringUp(
        arm=DEMO, sim=True, speed=10.0, without=("error_predictor", "stereo_bridge"),
        set={"kinematics": {"compiled": False}},
    )  # fmt: skip
    with running(up) as supervisor, ArmClient(arm) as client:
        client.ready(300.0, tip=False)
        assert shell("stop") == 0 and "torque off" in shell.err
        first = supervisor.pid("servo_driver")
        os.kill(first, signal.SIGKILL)
        client.until(
            lambda: supervisor.look() or supervisor.pid("servo_driver") != first, 300.0, "no driver"
        )
        found: dict[str, str] = {}

        def standing() -> str:
            found.update(shell.json("status"))
            return found["driver"]  # empty until the next one is on the graph

        client.until(standing, 300.0, "no driver on the graph")
        assert found["driver"].startswith("stopped") and found["next"] == "longarm reset"
        assert "emergency stop since" in found["why"]
    with forked_graph(up), ArmClient(arm) as client:
        with pytest.raises(DriverStopped, match="emergency stop since"):
            client.ready(300.0, tip=False)
        asks, target = graph.COMPENSATE.client(client.node), declared_model(arm).pose(arm.mid)

        def answer() -> str:
            asked = request(target, arm, execute=True)
            return str(client.call(asks, asked, 300.0, again=True).message)

        client.until(lambda: "stopped: emergency stop since" in answer(), 300.0, "no reason")
        assert shell("reset") == 0
        client.until(lambda: standing() == "ready", 300.0, "not ready")


SUPERVISE = """
import os, subprocess, sys
child = subprocess.Popen(sys.argv[1:], env={**os.environ, "LONGARM_SUPERVISOR": str(os.getpid())})
print(child.pid, flush=True)
child.wait()
"""


@pytest.mark.parametrize("gone", ["its terminal", "its supervisor"])
def test_a_driver_that_nobody_minds_any_more_stops_and_leaves_the_arm_up(
    fresh: Rig, gone: str
) -> None:
    """A closed terminal, or `longarm up` killed for its memory: a heavy arm must not fall."""
    rig = fresh
    if gone == "its supervisor":
        rig.ends()
        command = [sys.executable, "-m", "longarm_comp.nodes.servo_driver", "--ros-args"]
        rig.process = rig.stage.python(
            ["-c", SUPERVISE, *command, "--params-file", str(rig.file)]
        )  # fmt: skip
        rig.is_idle()
    rig.goes(shoulder=0.1)
    rig.send("on its way", shoulder=0.9)
    rig.stage.spin(lambda: rig.joints()["shoulder"] > 0.2)
    rig.process.send_signal(signal.SIGHUP if gone == "its terminal" else signal.SIGKILL)
    rig.becomes("on its way", Motion.ACCEPTED, Motion.BROKEN_OFF)
    rig.stage.spin(lambda: "ended" in rig.is_in(DriverState.UNCONFIGURED).message)
    assert rig.driving()
    rig.process.wait(timeout=300)
    at = rig.stands_still()["shoulder"]
    assert 0.2 < at < 0.85
    rig.start()
    rig.is_in(DriverState.READY)
    rig.is_idle()
    assert rig.joints()["shoulder"] == pytest.approx(at, abs=2e-3)
