"""`verify`, `loop`, `apply` and `undo` on a graph that stays up; the arm goes at once."""

import io
import itertools
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from cli_shell import Shell
from diagnosis_folders import small_networks
from hidden_arm import at
from nodes_bench import PATIENCE_S, bench
from own_graph import own_graph
from quick_arm import QuickArm, quick_arm
from small_arm import ARM
from target_requests import pose

from longarm_comp.core.compensation.result import Method
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.errors import JobError
from longarm_comp.core.files import write_text
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, read_stored, save_model, store
from longarm_comp.jobs.apply import apply_on_graph, files_at_work, reload
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.targets import TargetRunner, choose_targets
from longarm_comp.nodes import interfaces as graph
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import JointGain as TrueGain
from longarm_interfaces.srv import Compensate

QUICK = ("--sightings", "1", "--dwell", "0.08", "--move", "0.05")
PACE = Pace(sightings=1, dwell_s=0.08, move_s=0.05, look_s=PATIENCE_S)
GAIN, NOISE = 0.02, 1e-4
"""Of joint 2: the tip stands some 10 mm too high; and what a sighting errs by, m."""


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, QuickArm]]:
    """The folder with the model and the predictor of a graph that runs meanwhile; its arm."""
    folder = tmp_path_factory.mktemp("at_work")
    arm = folder / "arm.yaml"
    arm.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    true, noise = TrueArm(ARM, (TrueGain(at(2, GAIN)),), steps=2), np.random.default_rng(1)

    def seen(q: np.ndarray, side: np.ndarray) -> np.ndarray:
        return np.asarray(true.tip(q) + NOISE * noise.standard_normal(3))

    at_work = {"arm": arm, "model": folder / "model.yaml", "diagnostics_period_s": 0.2}
    with own_graph(folder), bench() as stage, quick_arm(ARM, lambda q: True, seen) as quick:
        kinematics = {"acknowledged": True, "move_time_s": 0.05}
        stage.start("kinematics", at_work | kinematics)
        stage.start("error_predictor", at_work | {"predictor": folder / "predictor.npz"})
        yield folder, quick


@pytest.fixture
def files(running: tuple[Path, QuickArm]) -> Path:
    return running[0]


@pytest.fixture
def client(files: Path) -> Iterator[ArmClient]:
    with ArmClient(ARM, name="test") as made:
        made.ready(PATIENCE_S)
        yield made


@pytest.fixture
def runner(client: ArmClient) -> TargetRunner:
    made = TargetRunner(client, PACE)
    made.ready(Model(ARM).tip(ARM.mid), PATIENCE_S)
    return made


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """What the user types from now on."""

    def typed(text: str) -> None:
        monkeypatch.setattr(sys, "stdin", io.StringIO(text))

    typed("")
    return typed


def at_work(client: ArmClient, files: Path, model: Model) -> None:
    """Has kinematics work with a model."""
    save_model(files / "model.yaml", store(model))
    reload(client, "kinematics")


def test_verify_says_whether_compensation_helps(
    files: Path, client: ArmClient, runner: TargetRunner, shell: Shell
) -> None:
    client.set_parameter("kinematics", "method", "deflection")
    at_work(client, files, Model(ARM, (JointGain(2, gain=GAIN),)))
    report = shell.json("verify", files / "arm.yaml", "-n", 3, *QUICK, "-o", "made")
    assert report == json.loads((shell.folder / "made" / "verify.json").read_text())
    assert (shell.folder / "made" / "verify.png").is_file()
    without, compensated = report["rows"]
    assert report["helps"] and without["n"] == compensated["n"] == 3
    assert without["mean_z_mm"] > 2.0  # the tip stands above its target
    assert compensated["mean_mm"] < 0.5
    for error in report["errors"]:
        assert error["without_mm"][2] > 2.0
    assert client.parameters("kinematics", "method") == ["deflection"]

    at_work(client, files, Model(ARM, (JointGain(2, gain=-GAIN),)))  # it makes it worse
    xyz = [error["target"] for error in report["errors"]]
    xyz.append([9.0, 0.0, 0.0])
    rows = "\n".join(",".join(map(str, row)) for row in xyz)
    (shell.folder / "targets.csv").write_text(f"x,y,z\n{rows}\n")
    assert shell("verify", files / "arm.yaml", "--targets", "targets.csv", *QUICK) == 3
    assert "does not help" in shell.out
    assert "1 targets refused" in shell.err
    assert "[9.0, 0.0, 0.0] was left out: none: " in shell.err
    (shell.folder / "seen.csv").write_text("x,y,z,frame\n0.5,0,0.3,measured\n")
    said = shell.refused("verify", files / "arm.yaml", "--targets", "seen.csv", *QUICK)
    assert "row 1, frame" in said
    with pytest.raises(JobError, match="fewer than two targets"):
        choose_targets(runner, lambda n: np.array([[9.0, 0.0, 0.0]]), 1, (Method.NONE,))


def test_a_method_belongs_to_the_request_and_outlasts_no_client(
    client: ArmClient, runner: TargetRunner
) -> None:
    """A program that is killed while it drives without compensation leaves nothing behind."""
    client.set_parameter("kinematics", "method", "deflection")
    told: dict[str, str] = {}
    graph.COMPENSATION.subscription(client.node, lambda m: told.__setitem__(m.id, m.method))
    near, nowhere = Model(ARM).tip(ARM.mid), np.full(3, np.nan)

    def hears() -> bool:
        """Ask until a record comes: those before the subscription is matched are lost."""
        runner.ask(near, Method.NONE, execute=False)
        return bool(told)

    client.until(hears, PATIENCE_S, "the record of a target")
    for method, target in itertools.product(Method, (near, nowhere)):
        answer = runner.ask(target, method, execute=False)
        assert answer.success == (target is near)
        client.until(lambda a=answer: a.id in told, PATIENCE_S, "the record of a target")
        assert told[answer.id] == method.value

    def watch(text: str, share: float) -> None:
        assert client.parameters("kinematics", "method") == ["deflection"]

    told.clear()
    runner.run("rigid", near[None], Method.NONE, watch)
    client.until(lambda: told, PATIENCE_S, "the record of a target")
    assert set(told.values()) == {"none"}
    plain = graph.COMPENSATE.client(client.node)
    asked = Compensate.Request(target=pose(near), position_only=True)
    answer = client.call(plain, asked, PATIENCE_S, again=True)
    client.until(lambda: answer.id in told, PATIENCE_S, "the record of a target")
    assert told[answer.id] == "deflection"


def test_a_move_that_is_over_before_the_wait_has_arrived(files: Path) -> None:
    path = np.stack([ARM.mid + 0.1 * (ARM.upper - ARM.mid), ARM.mid])
    pace = Pace(dwell_s=0.05, tolerance=1e-3)
    with ArmClient(ARM, "nobody_here") as client:
        client.joints = ARM.mid.copy()
        client.arrive(path, pace, ARM.lower)
        with pytest.raises(JobError, match="come to rest"):  # it has not left yet
            client.arrive(path, replace(pace, arrive_s=0.3), ARM.mid)
        with pytest.raises(JobError, match="come to rest"):
            client.arrive(path, replace(pace, arrive_s=0.3))


@pytest.mark.usefixtures("few_names")
def test_the_loop_asks_goes_on_and_is_taken_back(
    files: Path, client: ArmClient, runner: TargetRunner, shell: Shell,
    answers: Callable[[str], None], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("longarm_comp.workflows.apply.train", small_networks())
    at_work(client, files, Model(ARM))
    client.set_parameter("kinematics", "method", "both")
    kept = (files / "model.yaml").read_bytes()
    words = ("loop", files / "arm.yaml", "-o", "loop", "--rounds", 1, "--poses", 60, "--targets", 3)
    out = shell.folder / "loop"
    out.mkdir()
    (out / "poses.csv").write_text("mine")
    for how in ((), ("--resume",)):
        assert "not a file that loop writes" in shell.refused(*words, *QUICK, *how)
    assert [path.read_text() for path in out.iterdir()] == ["mine"]
    (out / "poses.csv").unlink()
    assert shell(*words, *QUICK) == 3, shell.err
    assert "there was no answer yes" in shell.err
    assert "joint_gain" in shell.err
    assert (files / "model.yaml").read_bytes() == kept
    shell.refused(*words, *QUICK)  # the folder is in use
    assert "as in the first call" in shell.refused(*words, *QUICK[:-1], "0.06", "--resume")
    session = sorted((out / "session").iterdir())
    made = [file.stat().st_mtime_ns for file in session]

    def killed(path: Path, text: str) -> None:
        if path.name == "steps.json" and "applied 1" in text:
            raise KeyboardInterrupt
        write_text(path, text)

    with pytest.MonkeyPatch.context() as patch:  # the model is replaced, and nobody knows it yet
        patch.setattr("longarm_comp.jobs.loop.write_text", killed)
        assert shell(*words, *QUICK, "--resume", "--yes") == 130, shell.err
    assert (files / "model.yaml").read_bytes() == (out / "diagnosis" / "model.yaml").read_bytes()
    report = shell.json(*words, *QUICK, "--resume", "--yes")
    assert [file.stat().st_mtime_ns for file in session] == made  # not collected again
    names = [row["run"] for row in report["rows"]]
    (turn,) = report["rounds"]
    assert (turn["collected"], turn["not_driven"]) == (60 + 2 * 5, {})
    refused = turn["applied"]["network_refused"]
    learned = [] if refused else ["round 1: effects found + network"]
    assert names == ["not compensated", "before", "round 1: effects found", *learned]
    assert "left out of its training" in refused or learned
    mean = [row["mean_mm"] for row in report["rows"]]
    assert min(mean[:2]) > 10 * mean[2]
    assert "joint_gain" in {change["what"] for change in turn["changes"]}
    page = (out / "loop.html").read_text()
    assert report["undo"] in page and turn["found"][:40] in page
    assert files_at_work(client).model == files / "model.yaml"
    load_model(files / "model.yaml", ARM)
    assert (files / "predictor.npz").is_file() == bool(learned)

    assert "in use already" in shell.refused("apply", turn["diagnosis"])
    assert shell("undo", files / "model.yaml") == 0
    assert (files / "model.yaml").read_bytes() == kept
    assert not (files / "predictor.npz").exists()
    reload(client, "kinematics")
    applied = apply_on_graph(client, Path(turn["diagnosis"]), network=False)
    assert applied.version == read_stored(files / "model.yaml").version
    assert len(applied.changes) == len(turn["changes"])
