"""Stops are kept: when a driver or a servo dies, and where nothing can be written."""

import os
import signal
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from driver_rig import Rig
from simulated_graph import forked_graph
from std_srvs.srv import SetBool, Trigger
from target_requests import request

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient, DriverStopped
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp, running
from longarm_comp.share import folder
from longarm_interfaces.msg import DriverState, Motion

DEMO = folder("config") / "arm_demo.yaml"


def test_a_reset_that_fails_leaves_the_stop_in_force(fresh: Rig) -> None:
    rig = fresh
    rig.emulator.unplug()
    answer = rig.call(graph.ESTOP, SetBool.Request(data=True))
    assert "not every servo confirms it" in answer.message and rig.driving()
    answer = rig.call(graph.RESET, Trigger.Request())
    assert not answer.success and "port" in answer.message
    rig.killed()
    rig.is_in(DriverState.ESTOP)
    rig.emulator.start()
    rig.stage.spin(rig.free)
    rig.refuses("~/estop")


def test_a_stop_frees_every_servo_that_hears_though_a_new_driver_finds_one_silent(
    fresh: Rig,
) -> None:
    """The driver died and cannot be configured; a person is caught."""
    rig = fresh
    rig.dies()
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
    rig.dies()
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
    rig.dies()
    state = tmp_path / "state"
    state.write_text("a file where the folder should be")
    rig.start(state=state)
    said = rig.is_in(DriverState.HOLDING).message
    assert "stops cannot be kept" in said and str(state) in said
    assert rig.driving()  # it does not drop
    rig.refuses(str(state))
    answer = rig.call(graph.RESET, Trigger.Request())
    assert not answer.success and str(state) in answer.message
    answer = rig.call(graph.ESTOP, SetBool.Request(data=True))
    assert answer.success and "ends with the driver" in answer.message and rig.free()
    rig.is_in(DriverState.ESTOP)
    state.unlink()
    rig.stage.spin(lambda: "ends with" not in rig.said[-1].message)  # written as soon as it can be
    rig.dies()
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
