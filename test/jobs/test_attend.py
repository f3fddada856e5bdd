"""`longarm status`, `hold`, `stop` and `reset`, on the real driver."""

import json
import os
import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from driver_rig import Rig
from nodes_bench import PATIENCE_S, bench
from own_graph import own_graph
from quick_arm import quick_arm
from small_arm import ARM
from std_srvs.srv import SetBool

import longarm_comp as la
from longarm_comp.cli import collect
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.errors import JobError
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.devices.stop_latch import Stop, StopLatch
from longarm_comp.jobs import attend
from longarm_comp.jobs.client import ArmClient, DriverStopped, Pace
from longarm_comp.jobs.graph_client import GraphClient, Interrupted
from longarm_comp.jobs.targets import TargetRunner
from longarm_comp.jobs.touch import release_servos
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.health import INSTANCE
from longarm_comp.nodes.messages import joints_message
from longarm_interfaces.msg import DriverState
from longarm_interfaces.srv import Compensate

TWO_JOINTS = Arm.parse(
    {
        "name": "rig", "convention": "mdh_craig", "tip": {"frame": 2, "position_m": [0.3, 0, 0]},
        "joints": [
            {"id": 1, "name": "shoulder", "type": "revolute", "limits_deg": [-28, 57]},
            {"id": 2, "name": "boom", "type": "prismatic", "alpha_deg": 90, "limits_m": [0, 0.1]},
        ],
    },
    "the rig's arm",
)  # fmt: skip


@pytest.fixture
def shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(tmp_path, capsys)


def resets(rig: Rig, shell: Shell) -> None:
    """`longarm reset`, again while a stop stands."""
    rig.stage.spin(lambda: shell("reset") == 0)


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rig has no other node than the driver: who is missing is known at once."""
    monkeypatch.setattr(attend, "ANNOUNCED_S", 0.5)


@pytest.mark.usefixtures("soon")
def test_an_arm_is_held_stopped_and_goes_on(rig: Rig, shell: Shell) -> None:
    found = shell.json("status")
    assert "no target is followed" in str(found["troubles"])  # kinematics died
    assert (found["driver"], found["next"]) == ("ready", "") and "servo_driver" in found["nodes"]
    rig.goes(shoulder=0.3)
    assert shell("hold") == 0 and "torque on" in shell.err
    rig.is_in(DriverState.HOLDING)
    assert rig.driving()
    assert shell.json("status")["next"] == "longarm reset"
    assert shell("stop") == 0 and rig.free()
    assert shell("status") == 0
    assert (
        "stopped: trajectories refused" in shell.out
        and "torque is off" in shell.out
        and "Next: longarm reset" in shell.out
    )
    resets(rig, shell)
    assert rig.driving()  # the hold before the stop has ended, too
    rig.is_in(DriverState.READY)
    rig.is_idle()
    rig.goes(shoulder=0.1)
    assert shell("reset") == 0 and "nothing to reset" in shell.err


@pytest.mark.usefixtures("soon")
def test_a_fault_is_told_with_its_cause_and_stays_until_it_is_cured(rig: Rig, shell: Shell) -> None:
    with rig.emulator.motor(1) as motor:
        motor.blocked = True
    rig.send("blocked", shoulder=0.9)
    rig.is_in(DriverState.FAULT)
    found = shell.json("status")
    assert "shoulder" in found["why"] and found["next"] == "longarm reset"
    assert any(t["level"] == "error" and "shoulder" in t["message"] for t in found["troubles"])
    with rig.emulator.motor(1) as motor:
        motor.blocked = False
    resets(rig, shell)
    rig.is_in(DriverState.READY)
    rig.emulator.unplug()
    rig.stage.spin(lambda: "unplugged" in rig.told("servo bus"))
    assert "unplugged" in str(shell.json("status")["troubles"])
    rig.emulator.start()
    rig.stage.spin(lambda: rig.told("servo bus") == "every servo answers")
    shell("reset")


def test_without_an_arm_the_command_says_so(
    rig: Rig, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attend, "FOUND_S", 0.3)
    stop = StopLatch(state_folder(), "/moon", "", "/dev/ttyMOON")
    stop.ask(Stop.ESTOP)
    stop.keep()
    for name, words in (
        ("status", "longarm up"), ("status", "port /dev/ttyMOON"), ("hold", "cut its power"),
        ("stop", "cut its power"),
    ):  # fmt: skip
        assert words in shell.refused(name, "--namespace", "moon", code=3)
    with stop.lift_stops(*Stop):
        pass


def test_another_program_with_the_id_of_a_node_elsewhere_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The node runs on another machine, where its process has an id that is in use here."""
    with subprocess.Popen(["sleep", "600"]) as program:
        values = [SimpleNamespace(key=INSTANCE, value=f"{program.pid}-0")]
        nodes = {name: {"process": SimpleNamespace(values=values)} for name in attend.KNOWN}
        reports = MagicMock(return_value=MagicMock(nodes=nodes))
        monkeypatch.setattr(attend, "Reports", reports)
        sent: list[int] = []
        try:
            with (
                monkeypatch.context() as patch,
                pytest.raises(JobError, match="another machine"),
            ):
                patch.setattr(os, "kill", lambda pid, number: sent.append(number))
                with attend.freeze_node(MagicMock(), "kinematics"):
                    pass
        finally:
            program.kill()
    assert not sent


def test_a_job_names_the_state_of_a_stopped_driver_at_once(rig: Rig, shell: Shell) -> None:
    assert shell("hold") == 0
    with ArmClient(TWO_JOINTS) as client:
        client.until(lambda: client.joints is not None, 300.0, "joints")
        with pytest.raises(DriverStopped, match="longarm reset"):
            client.ready(600.0, tip=False)
    resets(rig, shell)


def test_a_job_ends_where_another_program_commands_the_arm(rig: Rig) -> None:
    """Two `collect` at once would each take the other's poses for its own."""
    with ArmClient(TWO_JOINTS) as client:
        client.until(lambda: client.joints is not None, 300.0, "joints")
        client.ready(600.0, tip=False)
        path = np.array([[0.9, 0.02]])
        client.send(path)
        client.until(lambda: client._way[0] == client._sent, 300.0, "accepted")
        rig.send("another", shoulder=0.3)
        pace = Pace(tolerance=np.array([0.01, 0.001]), arrive_s=300.0)
        with pytest.raises(JobError, match="another program commanded the arm"):
            client.arrive(path, pace)
    rig.is_idle()


def test_a_job_that_is_interrupted_stops_what_it_moves(rig: Rig) -> None:
    rig.goes(shoulder=0.2)
    interrupted = threading.Event()
    with ArmClient(TWO_JOINTS, stop=interrupted) as client:
        client.ready(600.0, tip=False)
        client.send(np.array([[0.9, 0.02]]), 60.0)
        client.until(lambda: client._way[0] == client._sent, 300.0, "accepted")
        interrupted.set()
        with pytest.raises(Interrupted):
            client.look(np.array([[0.9, 0.02]]), Pace(), None)
    rig.is_in(DriverState.READY)
    assert rig.rests()["shoulder"] < 0.6


def test_the_wait_for_a_target_knows_what_to_stop() -> None:
    stands = joints_message(TWO_JOINTS, np.zeros(2))
    client = MagicMock(arm=TWO_JOINTS, seen_in="")
    client.call_to_move.return_value = Compensate.Response(
        success=True, id="its id", command=stands
    )
    client.look.return_value = 0, []
    TargetRunner(client, Pace()).run("targets", np.ones((1, 3)), Method.NONE, print)
    assert client.look.call_args.args[-1] == "its id"


def test_a_job_gives_no_target_under_a_stop(rig: Rig, shell: Shell) -> None:
    assert shell("hold") == 0
    with ArmClient(TWO_JOINTS) as client, pytest.raises(DriverStopped):
        client.until(lambda: client._driver is not None, 300.0, "state")
        TargetRunner(client, Pace()).run("targets", np.ones((3, 3)), Method.NONE, print)
    resets(rig, shell)


def test_a_stop_and_its_end_within_one_call_end_a_job(rig: Rig) -> None:
    with ArmClient(TWO_JOINTS) as client:
        client.until(lambda: client.joints is not None, 300.0, "joints")
        client.ready(600.0, tip=False)
        client.ready_to_move()
        for stop in (graph.HOLD, graph.ESTOP):
            before = client._driver
            assert rig.call(stop, SetBool.Request(data=True)).success
            assert rig.call(stop, SetBool.Request(data=False)).success
            rig.is_in(DriverState.READY)
            client.until(lambda before=before: client._driver != before, 300.0, "heard")
            nobody = graph.COMPENSATE.client(client.node)
            with pytest.raises(DriverStopped, match="was stopped meanwhile") as ended:
                client.call_to_move(nobody, Compensate.Request())
            assert not ended.value.held
            client.ready(600.0, tip=False)  # for another job
            client.ready_to_move()
        client._heard_s -= 10.0
        assert not client.driver_takes()
        client.ready_to_move()


def test_no_hand_guides_an_arm_in_fault(rig: Rig, shell: Shell) -> None:
    """Its stop would hide behind the fault, and the stop of another person with it."""
    with rig.emulator.motor(1) as motor:
        motor.blocked = True
    rig.send("blocked", shoulder=0.9)
    rig.is_in(DriverState.FAULT)
    with rig.emulator.motor(1) as motor:
        motor.blocked = False
    with (
        ArmClient(TWO_JOINTS) as client,
        pytest.raises(JobError, match="nothing is done: fault since"),
        release_servos(client),
    ):
        pass
    rig.is_in(DriverState.FAULT)
    assert rig.driving()
    resets(rig, shell)
    rig.is_in(DriverState.READY)


def test_a_hand_guides_the_arm_while_touches_are_taken(
    rig: Rig, shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`longarm touch --by-hand`: torque off meanwhile; driven again where the hand left it."""
    (tmp_path / "arm.yaml").write_text(
        json.dumps(TWO_JOINTS.model_dump(mode="json", exclude_defaults=True)), encoding="utf-8"
    )
    rig.goes(shoulder=0.3)
    ways = iter([{"shoulder": 0.1, "boom": 0.04}, {"shoulder": -0.2, "boom": 0.06}])
    guided: list[dict[str, float]] = []

    def asked(prompt: str, *_: object) -> str:
        assert rig.free()
        to = next(ways, None)
        if to is None:
            return "end"
        for joint in rig.arm.joints:
            rig.emulator.push(joint.servo_id, joint.ticks(to[joint.name]))
        guided.append(to)
        return ""

    monkeypatch.setattr(collect, "_ask_line", asked)
    out = tmp_path / "touches.csv"
    assert shell("touch", tmp_path / "arm.yaml", "-o", out, "--by-hand", "--json") == 0, shell.err
    found = la.read_session(out, TWO_JOINTS)
    np.testing.assert_allclose(found.q, [list(to.values()) for to in guided], atol=2e-3)
    rig.stage.spin(rig.driving)
    rig.is_in(DriverState.READY)
    rig.is_idle()
    assert rig.joints() == pytest.approx(guided[-1], abs=2e-3)

    # A stop of somebody else is nobody else's to end
    def pressed(prompt: str, *_: object) -> str:
        assert shell("stop") == 0
        return "end"

    monkeypatch.setattr(collect, "_ask_line", pressed)
    again = ("touch", tmp_path / "arm.yaml", "-o", out, "--by-hand", "--resume")
    assert "the stop stays: emergency stop since" in shell.refused(*again, code=3)
    rig.is_in(DriverState.ESTOP)
    assert rig.free()
    assert "nothing is done: emergency stop since" in shell.refused(*again, code=3)
    resets(rig, shell)
    rig.is_in(DriverState.READY)


def test_torque_is_on_again_after_a_signal_while_it_went_off(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = attend.Attendant.stop

    def stop_and_signal(attendant: attend.Attendant) -> str:
        said = stop(attendant)
        signalled.set()
        return said

    monkeypatch.setattr(attend.Attendant, "stop", stop_and_signal)
    signalled = threading.Event()
    with (
        ArmClient(TWO_JOINTS, stop=signalled) as client,
        pytest.raises(Interrupted),
        release_servos(client),
    ):
        client.spin(1.0)
    rig.stage.spin(rig.driving)
    rig.is_in(DriverState.READY)


def test_a_driver_that_is_heard_of_last_is_on_the_graph(tmp_path: Path, shell: Shell) -> None:
    """Each node announces itself when it likes: kinematics is found, the driver not yet."""
    arm, done = tmp_path / "arm.yaml", threading.Event()
    arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))

    def drive() -> None:
        time.sleep(1.5)
        with quick_arm(ARM, lambda q: True):
            done.wait()

    with own_graph(tmp_path), bench() as stage:
        heard = stage.collect(graph.DIAGNOSTICS)
        stage.start("kinematics", {"arm": arm, "acknowledged": True, "diagnostics_period_s": 0.2})
        stage.spin(lambda: heard)
        driver = threading.Thread(target=drive)
        driver.start()
        try:
            found = shell.json("status")
        finally:
            done.set()
            driver.join()
    assert (found["driver"], found["next"]) == ("ready", "")
    assert "kinematics" in found["nodes"] and "no target is followed" not in str(found)


def test_a_node_that_follows_paths_and_does_not_report_is_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It reports once a minute, so that it is as silent as one that hangs."""
    monkeypatch.setattr(attend, "FOUND_S", 1.0)
    arm = tmp_path / "arm.yaml"
    arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    with own_graph(tmp_path), bench() as stage, GraphClient() as client:
        stage.start("trajectory_compensator", {"arm": arm, "diagnostics_period_s": 60.0})
        named = client.node.get_node_names
        client.until(lambda: "trajectory_compensator" in named(), PATIENCE_S, "the node")
        found = attend.Attendant(client).standing()
    told = {t["node"]: t["message"] for t in found["troubles"]}
    assert "does not report" in told["trajectory_compensator"]
    assert "not on the graph" in told["kinematics"]
