"""What the commands do, from end to end."""

import csv
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli_shell import Shell, real
from session_bag import write_bag
from small_arm import ARM, measured

from bench import catalogue
from longarm_comp.cli.output import print_rows
from longarm_comp.cli.registry import COMMANDS
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import Plan, paper_grid
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sessions.poses import write_poses


def test_calibrate_reports_the_ladder_and_writes_the_model(work: Path, shell: Shell) -> None:
    made = shell.json("calibrate", work / "arm.yaml", work / "samples.csv", "-o", "model.yaml")
    names = [row["model"] for row in made["held_out"]]
    assert names == ["nominal", "frames_only", "joint_zeros", "geometry"]
    assert made["held_out"][3]["mean_mm"] < made["held_out"][0]["mean_mm"]
    assert made["session_hash"] == read_csv(work / "samples.csv", ARM).hash
    for parameter in made["parameters"]:
        low, high = parameter["ci95"]
        assert low < parameter["value"] < high
    stored = yaml.safe_load((shell.folder / "model.yaml").read_text())
    assert stored["version"] == 1
    assert stored["provenance"]["session_hash"] == made["session_hash"]
    again = shell.json("calibrate", work / "arm.yaml", work / "samples.csv", "-o", "again.yaml")
    assert again["held_out"] == made["held_out"]


def test_calibrate_fits_declared_effects(work: Path, shell: Shell) -> None:
    command = ("calibrate", work / "arm.yaml", work / "samples.csv", "-o", "m.yaml")
    made = shell.json(*command, "--effect", "joint_gain")
    assert made["held_out"][-1]["model"] == "joint_gain"
    named = {p["effect"] for p in made["parameters"] if not p["geometry"]}
    assert named == {"joint_gain"}
    before, after = (row["rms_mm"] for row in made["held_out"][-2:])
    assert ("joint_gain did not lower the held-out error" in shell.err) == (after >= before)


def test_undo_brings_the_version_before_back(work: Path, shell: Shell) -> None:
    command = ("calibrate", work / "arm.yaml", work / "samples.csv", "-o", "m.yaml")
    assert shell(*command) == 0
    before = (shell.folder / "m.yaml").read_bytes()
    assert shell(*command, "--effect", "joint_gain") == 0
    assert (shell.folder / "m.yaml").read_bytes() != before
    assert shell("undo", "m.yaml") == 0
    assert (shell.folder / "m.yaml").read_bytes() == before
    assert "previous version" in shell.refused("undo", "m.yaml")


def test_evaluate_shows_every_stage(work: Path, shell: Shell) -> None:
    made = shell.json(
        *("evaluate", work / "arm.yaml", "--test", work / "test.csv"),
        *("--model", work / "model.yaml", "--predictor", work / "predictor.npz"),
    )
    rows = {row["model"]: row for row in made["rows"]}
    assert list(rows) == ["rigid", "calibrated", "network"]
    session = read_csv(work / "test.csv", ARM)
    error = np.linalg.norm(session.xyz - Model(ARM).tip(session.q), axis=1)
    assert rows["rigid"]["mean_mm"] == pytest.approx(1e3 * error.mean(), rel=1e-9)
    assert rows["rigid"]["max_mm"] == pytest.approx(1e3 * error.max(), rel=1e-9)
    assert rows["network"]["rms_mm"] < 0.5 * rows["calibrated"]["rms_mm"]
    assert rows["calibrated"]["rms_mm"] < rows["rigid"]["rms_mm"]


def test_a_bag_does_where_a_csv_does(work: Path, shell: Shell) -> None:
    arm, test = work / "arm.yaml", work / "test.csv"
    write_bag(read_csv(test, ARM), "bag", ARM, "sqlite3")
    bag = shell.json("evaluate", arm, "--test", "bag", "--model", work / "model.yaml")
    table = shell.json("evaluate", arm, "--test", test, "--model", work / "model.yaml")
    assert bag["rows"] == table["rows"]
    info = shell.json("bag", "info", "bag")
    counts = {topic["topic"]: topic["count"] for topic in info["topics"]}
    assert counts["/joint_trajectory"] == counts["/tip_measured"] == 30
    made = shell.json("bag", "to-csv", arm, "bag", "-o", "back.csv")
    assert made["rows"] == 30
    back, session = read_csv("back.csv", ARM), read_csv(test, ARM)
    assert (back.xyz == session.xyz).all()
    assert (back.approach == session.approach).all()
    edited = Path("back.csv").read_text().replace("repeat_id", "repeat_id,role", 1)
    Path("back.csv").write_text(edited)
    assert "--force" in shell.refused("bag", "to-csv", arm, "bag", "-o", "back.csv")
    assert Path("back.csv").read_text() == edited
    assert shell("bag", "to-csv", arm, "bag", "-o", "back.csv", "--force") == 0
    assert Path("back.csv").read_text() != edited


def test_evaluate_points_out_the_session_that_was_fitted(work: Path, shell: Shell) -> None:
    """The model and the predictor know the session that they come from, in any file."""
    both = ("--model", work / "model.yaml", "--predictor", work / "predictor.npz")
    fresh = shell.json("evaluate", work / "arm.yaml", "--test", work / "test.csv", *both)
    assert fresh["fitted_to_test"] == []
    assert "use other poses" not in shell.err
    session = read_csv(work / "samples.csv", ARM)
    write_csv(session, "copy.csv")
    known = ("evaluate", work / "arm.yaml", "--test", "copy.csv")
    assert shell.json(*known, *both)["fitted_to_test"] == ["model", "predictor"]
    assert shell.json(*known, *both[:2])["fitted_to_test"] == ["model"]
    assert shell.json(*known)["fitted_to_test"] == []
    assert shell(*known, *both) == 0
    assert "the model and the predictor came from this session: use other poses" in shell.err
    write_csv(measured(50, np.random.default_rng(9)), "other.csv")
    shell("train", work / "arm.yaml", "other.csv", *both[:2], "-o", "p.npz",
          "--ensemble", 1, "--hidden", 4)  # fmt: skip
    crossed = ("--test", "other.csv", *both[:2], "--predictor", "p.npz")
    assert shell.json(*known[:2], *crossed)["fitted_to_test"] == ["predictor"]


def test_compensate_takes_the_error_off(work: Path, shell: Shell) -> None:
    session = read_csv(work / "test.csv", ARM)
    inside = np.abs(session.q - ARM.mid).max(1).argsort()[:5]
    targets = Model(ARM).tip(session.q[inside])
    np.savetxt("targets.csv", targets, delimiter=",", header="x,y,z", comments="")
    command = (
        *("compensate", work / "arm.yaml", "--targets", "targets.csv", "--frame", "measured"),
        *("--model", work / "model.yaml", "-o", "commands.csv", "--force"),
    )

    def missed() -> float:
        with open("commands.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["status"] for row in rows] == ["success"] * 5
        q = np.array([[float(row[f"q{j}"]) for j in range(1, 5)] for row in rows])
        return float(np.linalg.norm(real(q) - targets, axis=1).mean())

    assert shell(*command, "--method", "none") == 0
    before = missed()
    assert shell(*command, "--predictor", work / "predictor.npz") == 0
    assert missed() < 0.5 * before


@pytest.mark.parametrize("method", ["none", "deflection"])
@pytest.mark.parametrize("every", [21, pytest.param(1, marks=pytest.mark.long)])
def test_compensate_reaches_the_whole_grid_from_a_file_of_nine_decimals(
    method: str, every: int, demo_arm_path: Path, shell: Shell
) -> None:
    arm = Arm.load(demo_arm_path)
    model = declared_model(arm) if method == "deflection" else Model(arm)
    targets = model.tip(paper_grid(arm)[::every])
    np.savetxt("grid.csv", targets, fmt="%.9f", delimiter=",", header="x,y,z", comments="")
    command = ("compensate", demo_arm_path, "--targets", "grid.csv", "-o", "commands.csv")
    assert shell(*command, "--method", method) == 0
    with open("commands.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["success"] * len(targets)
    q = np.array([[float(row[f"q{j}"]) for j in range(1, 8)] for row in rows])
    assert np.linalg.norm(model.tip(q) - targets, axis=1).max() < 1e-6


@pytest.mark.parametrize("joint", ["joint4", 4])
def test_compensate_one_target_with_its_options(joint: object, work: Path, shell: Shell) -> None:
    x, y, z = Model(ARM).tip(ARM.mid - np.array([0.3, 0, 0, 0]))
    assert y < 0  # a number with a sign is no option
    seed = ",".join(str(v) for v in ARM.mid - np.array([0.2, 0, 0, 0]))
    made = shell.json("compensate", work / "arm.yaml", x, y, z, "--seed-q", seed, "--lock", joint)
    (command,) = made["commands"]
    assert made["method"] == "deflection"
    assert command["status"] == "success"
    assert command["q4"] == ARM.mid[3]
    q = [command[f"q{j}"] for j in range(1, 5)]
    assert np.allclose(Model(ARM).tip(np.array(q)), [x, y, z], atol=1e-8)


def test_outside_the_training_data_physics_is_used_and_said(work: Path, shell: Shell) -> None:
    few = read_csv(work / "samples.csv", ARM)
    few = few.take(few.q[:, 0] < 0)
    write_csv(few, "half.csv")
    train = ("train", work / "arm.yaml", "half.csv", "--model", work / "model.yaml")
    assert shell(*train, "-o", "half.npz", "--ensemble", 1, "--hidden", 3) == 0
    x, y, z = Model(ARM).tip(ARM.mid + np.array([0.5, 0, 0, 0]))
    made = shell.json(
        *("compensate", work / "arm.yaml", x, y, z, "--lock", 2, "--seed-q"),
        ",".join(str(v) for v in ARM.mid + np.array([0.5, 0, 0, 0])),
        *("--model", work / "model.yaml", "--predictor", "half.npz", "--frame", "measured"),
    )
    (command,) = made["commands"]
    assert command["status"] in ("out_of_domain", "success")
    assert "outside" in command["reason"] and "physics only" in command["reason"]
    assert command["p90_mm"] > command["expected_mm"] > 0.0


@pytest.mark.parametrize("kind", ["grid", "sobol"])
def test_plan(kind: str, work: Path, shell: Shell) -> None:
    command = ("plan", work / "arm.yaml", "--kind", kind, "-n", 12, "--seed", 4)
    made = shell.json(*command, "-o", "a.csv")
    assert np.shape(made["poses"]) == (12, 4)
    assert shell(*command, "-o", "b.csv") == 0
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()


def test_plan_what_a_diagnosis_asks_for(work: Path, shell: Shell) -> None:
    Path("diagnosis").mkdir()
    wanted = np.array([ARM.lower, ARM.mid, ARM.upper])
    write_poses(Plan(wanted, np.array([1, -1, -1])), "diagnosis/next_poses.csv")
    plan = ("plan", work / "arm.yaml", "--kind", "next", "--report", "diagnosis", "-n")
    made = shell.json(*plan, 2)
    assert np.allclose(made["poses"], [ARM.lower, ARM.mid])
    assert made["approach"] == [[1] * 4, [-1] * 4]
    assert "1 to 3" in shell.refused(*plan, 4)
    assert "--report" in shell.refused("plan", work / "arm.yaml", "--kind", "next", "-n", 2)


ONE_JOINT = (
    '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
    '<parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>'
)


def test_an_arm_alone_of_a_urdf(shell: Shell) -> None:
    Path("r.urdf").write_text(ONE_JOINT)
    urdf = ("--urdf", "r.urdf", "--only-arm", "--base", "a", "--tip")
    assert shell("init", "one", *urdf, "b") == 0
    assert Arm.load("one/arm.yaml").joint_names == ("j",)
    assert "DIR" in shell.refused("init", "one", *urdf, "b")
    assert "--tip" in shell.refused("init", "other", *urdf, "z")


def test_import_urdf(shell: Shell) -> None:
    Path("r.urdf").write_text(ONE_JOINT)
    assert shell("import-urdf", "r.urdf", "--base", "a", "--tip", "b", "-o", "arm.yaml") == 0
    assert Arm.load("arm.yaml").joint_names == ("j",)
    assert "--force" in shell.refused("import-urdf", "r.urdf", "--base", "a", "--tip", "b")
    other = ("--base", "a", "--tip", "z", "-o", "other.yaml")
    assert "--tip" in shell.refused("import-urdf", "r.urdf", *other)


def test_bench_gives_the_agreed_rows(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def row(name: str) -> dict[str, object]:
        return {"name": name, "value": 2.0, "unit": "us", "peer": "p", "peer_value": 6.0,
                "ratio": 3.0, "spread": [1.0, float("nan")]}  # fmt: skip

    monkeypatch.setattr(catalogue, "run", row)
    made = shell.json("bench")
    assert [r["name"] for r in made["results"]] == list(catalogue.KIND_OF)
    assert made["results"][0]["spread"] == [1.0, None]
    assert made["machine"]
    assert shell("bench", "ssa_evals_vs_mealpy_300") == 0
    assert "3.000" in shell.out
    assert "ssa_evals_vs_mealpy_900" in shell.refused("bench", "ssa_evals")


def test_every_benchmark_is_where_the_list_says() -> None:
    for names in catalogue.BENCHMARKS.values():
        for place, *given in names.values():
            module, _, function = place.partition(".")
            work = getattr(importlib.import_module(f"bench.{module}"), function)
            inspect.signature(work).bind(*given)


def test_a_table_without_rows_is_not_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows("What the monitor asked for", [])
    assert capsys.readouterr().out == ""


def test_the_names_that_other_programs_call_stay() -> None:
    fixed = (
        "demo,calibrate,train,compensate,evaluate,diagnose,plan,collect,record,bag info,bag to-csv,"
        "study,bench,up,import-urdf,init,import-data,export-urdf,verify,apply,undo,loop,"
        "stereo calibrate,stereo hand-eye,stereo marker,servo scan,servo setup,view"
    )
    assert set(fixed.split(",")) <= {entry.name for entry in COMMANDS}
