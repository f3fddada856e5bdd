"""`verify`, `loop`, `apply` and `undo` as a user runs them, on a graph that stays up."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from conftest import claimed_domain

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.compensate import Method
from longarm_comp.core.errors import JobError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored, save_model, store
from longarm_comp.jobs.apply import apply_on_graph, files_at_work, reload
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.demo import TrueTip
from longarm_comp.jobs.targets import TargetRunner
from longarm_comp.jobs.verify import choose
from longarm_comp.nodes.bringup import BringUp, running

QUICK = ("--sightings", "2", "--dwell", "0.2", "--move", "0.05")
PACE = Pace(sightings=2, dwell_s=0.2, move_s=0.05)


@pytest.fixture(scope="module")
def domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with claimed_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        yield


@pytest.fixture(scope="module")
def files(
    domain: None, demo_arm_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """The folder with the model and the predictor of a graph that runs meanwhile."""
    folder = tmp_path_factory.mktemp("at_work")
    bringup = BringUp(
        arm=demo_arm_path,
        model=folder / "model.yaml",
        predictor=folder / "predictor.npz",
        sim=True,
        speed=20.0,
        set={
            "simulated_arm": {
                "hidden": "joint_compliance=8.0 backlash=3.0", "frame_rate_hz": 10.0,
            },
            "servo_driver": {"follower.blend_s": 0.05},
            "kinematics": {"move_time_s": 0.05, "compiled": False},
        },
    )  # fmt: skip
    with running(bringup):
        yield folder


@pytest.fixture
def client(files: Path, demo_arm_path: Path) -> Iterator[ArmClient]:
    with ArmClient(Arm.load(demo_arm_path), name="test") as made:
        made.ready(120.0)
        yield made


@pytest.fixture
def runner(client: ArmClient) -> TargetRunner:
    made = TargetRunner(client, PACE)
    made.ready(declared_model(client.arm).tip(client.arm.mid), 120.0)
    return made


def longarm(*words: object, answer: str = "") -> subprocess.CompletedProcess[str]:
    """The program; ``answer`` is what the user types."""
    done = subprocess.run(
        [sys.executable, "-m", "longarm_comp", *map(str, words)],
        input=answer, text=True, capture_output=True, timeout=900,
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done


def at_work(client: ArmClient, files: Path, model: Model) -> None:
    """Has kinematics work with a model."""
    save_model(files / "model.yaml", store(model))
    reload(client, "kinematics")


def test_verify_says_whether_compensation_helps(
    files: Path, demo_arm_path: Path, client: ArmClient, runner: TargetRunner, tmp_path: Path
) -> None:
    client.set_parameter("kinematics", "method", "deflection")
    done = longarm("verify", demo_arm_path, "-n", 3, *QUICK, "--json", "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report == json.loads((tmp_path / "verify.json").read_text())
    assert (tmp_path / "verify.png").is_file()
    without, compensated = report["rows"]
    assert report["helps"] and without["n"] == compensated["n"] == 3
    assert without["mean_z_mm"] < -10.0  # the tip hangs below its target
    assert compensated["mean_mm"] < 0.7 * without["mean_mm"]
    for error in report["errors"]:
        assert error["without_mm"][2] < -10.0
    assert client.parameters("kinematics", "method") == ["deflection"]

    at_work(client, files, Model(client.arm))  # nothing bends: it compensates nothing
    targets = tmp_path / "targets.csv"
    xyz = [error["target"] for error in report["errors"]]
    xyz.append([9.0, 0.0, 0.0])
    rows = "\n".join(",".join(map(str, row)) for row in xyz)
    targets.write_text(f"x,y,z\n{rows}\n")
    done = longarm("verify", demo_arm_path, "--targets", targets, *QUICK)
    assert done.returncode == 3, done.stderr
    assert "does not help" in done.stdout
    assert "1 targets refused" in done.stderr
    assert "[9.0, 0.0, 0.0] was left out: none: " in done.stderr
    with pytest.raises(JobError, match="fewer than two targets"):
        choose(runner, lambda n: np.array([[9.0, 0.0, 0.0]]), 1, (Method.NONE,))


def test_a_move_that_is_over_before_the_wait_has_arrived(domain: None, demo_arm_path: Path) -> None:
    arm = Arm.load(demo_arm_path)
    path = np.stack([arm.mid + 0.1 * (arm.upper - arm.mid), arm.mid])
    pace = Pace(dwell_s=0.05, tolerance=1e-3)
    with ArmClient(arm, "nobody_here") as client:
        client.joints = arm.mid.copy()
        client.arrive(path, pace, arm.lower)
        with pytest.raises(JobError, match="come to rest"):  # it has not left yet
            client.arrive(path, replace(pace, arrive_s=0.3), arm.mid)
        with pytest.raises(JobError, match="come to rest"):
            client.arrive(path, replace(pace, arrive_s=0.3))


def test_play_grows_while_the_simulation_runs(client: ArmClient, runner: TargetRunner) -> None:
    witness = TrueTip(client)
    arm = client.arm
    now = lambda: int(client.node.get_clock().now().nanoseconds)  # noqa: E731
    for bad in ("elbow=0.01", "joint1=much", "joint1=-0.1"):
        with pytest.raises(JobError, match=r"joint|more_play"):
            client.set_parameter("simulated_arm", "more_play", bad)
    stood = np.array(client.joints)
    q = np.clip(stood + 0.1 * (arm.mid - stood), arm.lower, arm.upper)
    client.send(q[None], 0.05)
    client.arrive(q[None], Pace(tolerance=5e-4))
    before = witness(now())
    client.set_parameter("simulated_arm", "more_play", "joint1=0.01")
    client.spin(0.3)
    after = witness(now())
    radius = np.linalg.norm(before[:2])
    assert np.linalg.norm(after - before) == pytest.approx(0.005 * radius, rel=0.05)
    client.set_parameter("simulated_arm", "more_play", "")
    client.spin(0.3)
    np.testing.assert_allclose(witness(now()), before, atol=1e-6)


@pytest.mark.long
def test_the_loop_asks_goes_on_and_is_taken_back(
    files: Path, demo_arm_path: Path, client: ArmClient, runner: TargetRunner, tmp_path: Path
) -> None:
    at_work(client, files, declared_model(client.arm))
    client.set_parameter("kinematics", "method", "both")
    kept = (files / "model.yaml").read_bytes()
    out = tmp_path / "loop"
    words = ("loop", demo_arm_path, "-o", out, "--rounds", 1, "--poses", 70, "--targets", 3, *QUICK)
    unanswered = longarm(*words)
    assert unanswered.returncode == 3 and "no answer yes" in unanswered.stderr
    assert "servo_droop" in unanswered.stderr or "joint_compliance" in unanswered.stderr
    assert (files / "model.yaml").read_bytes() == kept
    assert longarm(*words).returncode == 2  # the folder is in use
    other = longarm(*words[:-1], "0.06", "--resume")
    assert other.returncode == 2 and "as in the first call" in other.stderr
    session = sorted((out / "session").iterdir())
    made = [file.stat().st_mtime_ns for file in session]
    done = longarm(*words, "--resume", "--yes", "--json")
    assert done.returncode == 0, done.stderr
    assert [file.stat().st_mtime_ns for file in session] == made  # not collected again
    report = json.loads(done.stdout)
    names = [row["run"] for row in report["rows"]]
    (turn,) = report["rounds"]
    refused = turn["applied"]["network_refused"]
    learned = [] if refused else ["round 1: effects found + network"]
    assert names == ["not compensated", "before", "round 1: effects found", *learned]
    assert "left out of its training" in refused or learned
    mean = [row["mean_mm"] for row in report["rows"]]
    assert mean[0] > mean[1] > 5 * mean[2]
    changed = {change["what"] for change in turn["changes"]}
    assert changed & {"servo_droop", "joint_compliance"}
    page = (out / "loop.html").read_text()
    assert report["undo"] in page and turn["found"][:40] in page
    assert files_at_work(client).model == files / "model.yaml"
    load_model(files / "model.yaml", client.arm)
    assert (files / "predictor.npz").is_file() == bool(learned)

    again = longarm("apply", turn["diagnosis"])
    assert again.returncode == 2 and "in use already" in again.stderr
    assert longarm("undo", files / "model.yaml").returncode == 0
    assert (files / "model.yaml").read_bytes() == kept
    assert not (files / "predictor.npz").exists()
    reload(client, "kinematics")
    applied = apply_on_graph(client, Path(turn["diagnosis"]), network=False)
    assert applied.version == read_stored(files / "model.yaml").version
    assert len(applied.changes) == len(turn["changes"])
