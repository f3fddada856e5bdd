"""`longarm up` with arms that are not the demonstration's, over a real graph."""

import re
import signal
import subprocess
import sys
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from some_arms import COLUMN, HOBBY

from longarm_comp.cli.up import alone
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.jobs.attend import freeze_node
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.nodes.bringup import BringUp
from longarm_comp.share import folder


def test_a_new_folder_runs_faults_are_rehearsed_and_a_second_graph_is_refused(
    ros_domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A column with two stages: every joint moves, and the tip is seen where it should be."""
    shell = Shell(tmp_path, capsys)
    assert shell("init", tmp_path / "column", *COLUMN) == 0
    file = tmp_path / "column" / "arm.yaml"
    arm = Arm.load(file)
    up = [sys.executable, "-m", "longarm_comp", "up", str(file), "--sim", "--speed", "10"]
    process = subprocess.Popen(up, text=True, stderr=subprocess.PIPE)
    goal = arm.mid + 0.2 * (arm.upper - arm.lower) * np.array([1.0, -1.0, 1.0, -1.0])
    try:
        with ArmClient(arm) as client:
            client.ready(120.0)
            assert client.joints is not None
            assert np.abs(goal - client.joints).min() > 0.05
            pace = Pace(sightings=2, dwell_s=0.1, arrive_s=120.0, look_s=60.0, tolerance=2e-3)
            start = client.joints
            client.send(goal[None], 0.1)
            _, seen = client.look(goal[None], pace, start)
            np.testing.assert_allclose(
                np.mean(seen, axis=0), declared_model(arm).tip(goal), atol=2e-3
            )

            def lost() -> bool:
                return bool(np.isnan(client.sightings[-1][1]).all())

            def standing() -> str:
                shell("status")
                return shell.out + shell.err

            assert "a graph is already running in this namespace" in shell.refused(*up[3:], code=3)
            assert shell("sim", "cover", "left") == 0, shell.err
            assert "covered: left" in shell.err
            client.until(lost, 300.0, "the marker is still seen")
            assert shell("sim", "cover", "left", "--back") == 0
            client.until(lambda: not lost(), 300.0, "the marker is not seen again")
            assert "swing" in shell.refused("sim", "unplug", "knee", code=3)
            assert shell("sim", "unplug", "swing") == 0
            client.until(lambda: "did not answer" in standing(), 300.0, "no fault in status")
            assert shell("sim", "unplug", "swing", "--back") == 0
            client.until(lambda: "did not answer" not in standing(), 300.0, "still a fault")
            said = shell.refused("sim", "freeze", "elbow")
            assert "kinematics" in said and "simulated_arm" in said
            with freeze_node(client, "simulated_arm") as pid:
                client.until(lambda: stopped(pid), 300.0, "it goes on")
            client.until(lambda: not stopped(pid), 300.0, "it stays frozen")
        process.send_signal(signal.SIGINT)
        noise = process.communicate(timeout=300)[1]
    finally:
        process.kill()
    assert process.returncode == 0, noise


def test_a_graph_of_this_machine_is_noticed_before_it_is_discovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ros_domain: int
) -> None:
    """Nothing is on the middleware here; what refuses is that an `up` holds the namespace."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    stop = threading.Event()
    with alone("boom/left", stop):
        with pytest.raises(JobError, match="a graph is already running"), alone("boom/left", stop):
            pass
        with alone("another", stop):
            pass
    with alone("boom/left", stop):  # the lock ended with its holder
        pass


def stopped(pid: int) -> bool:
    """Whether a process is stopped by a signal."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def test_a_bare_arm_gets_files_that_fit_in_simulation_only(tmp_path: Path) -> None:
    assert Shell(tmp_path)("init", tmp_path / "whole", *HOBBY) == 0
    bare = tmp_path / "bare" / "arm.yaml"
    bare.parent.mkdir()
    bare.write_text((tmp_path / "whole" / "arm.yaml").read_text())
    (bare.parent / "kinematics.yaml").write_text((folder("config") / "kinematics.yaml").read_text())
    scratch = tmp_path / "scratch"
    graph = BringUp(arm=bare, sim=True).with_servos(scratch)
    servos = ServoConfig.load(graph.file("servo_driver"))
    assert tuple(servos.joints) == Arm.load(bare).joint_names
    assert graph.parameters("simulated_arm", "")["servos"] == str(scratch / "servo_driver.yaml")
    assert graph.file("kinematics") == scratch / "kinematics.yaml"
    assert graph.file("error_predictor") == folder("config") / "error_predictor.yaml"
    with pytest.raises(InputError, match=r"servo_driver.yaml: 'missing'.* longarm init DIR --arm"):
        BringUp(arm=bare).with_servos(scratch)
    given = tmp_path / "given"
    given.mkdir()
    (given / "servo_driver.yaml").write_text((folder("config") / "servo_driver.yaml").read_text())
    with pytest.raises(InputError, match="given"):
        BringUp(arm=bare, sim=True, config=given).with_servos(scratch)
    bare.write_text((folder("config") / "arm_demo.yaml").read_text())  # joints of the same names
    with pytest.raises(InputError, match=r"servo_driver.yaml: 'missing'.* longarm init DIR --arm"):
        BringUp(arm=bare).with_servos(scratch)


def test_files_beside_the_arm_are_used(tmp_path: Path) -> None:
    assert Shell(tmp_path)("init", tmp_path / "mine", *HOBBY) == 0
    graph = BringUp(arm=tmp_path / "mine" / "arm.yaml", sim=True)
    assert graph.with_servos(tmp_path) is graph
    servos = tmp_path / "mine" / "servo_driver.yaml"
    text = servos.read_text()
    for old, new, field in (
        (r"upper: 1.04\d+", "upper: 1.2", "joints.joint1.upper"),
        (r"max_velocity: [\d.]+", "max_velocity: 45.0", "joints.joint1.max_velocity"),
        (r"stall_time_s: [\d.]+", "stall_time_s: 500.0", "follower.stall_time_s"),
    ):
        servos.write_text(re.sub(old, new, text, count=1))
        for sim in (False, True):
            with pytest.raises(InputError, match=rf"servo_driver.yaml: {field}: "):
                replace(graph, sim=sim).with_servos(tmp_path)
    servos.write_text(text)
    assert graph.file("stereo_bridge") == tmp_path / "mine" / "stereo_bridge.yaml"
