"""The command line from end to end: results, exit codes, one-line errors, quick start."""

from __future__ import annotations

import csv
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import yaml
from small_arm import ARM, measured

from longarm_comp.bench import catalogue
from longarm_comp.cli import registry, run
from longarm_comp.core.arm import Arm
from longarm_comp.core.dataset import Session
from longarm_comp.core.model import Model
from longarm_comp.core.plan import Plan
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sessions.poses import write_poses

HEAVY = ("torch", "numpy", "scipy", "matplotlib", "rclpy", "rich", "pydantic", "sklearn")


class Shell:
    """Runs ``longarm`` in one folder and keeps what it said."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str] | None = None) -> None:
        self.folder, self._capsys = folder, capsys
        self.out = self.err = ""

    def __call__(self, *words: object) -> int:
        code = run.run([str(word) for word in words])
        if self._capsys is not None:
            self.out, self.err = self._capsys.readouterr()
        return code

    def json(self, *words: object) -> Any:
        code = self(*words, "--json")
        assert code == 0, self.err
        return json.loads(self.out)

    def refused(self, *words: object, code: int = 2) -> str:
        """The error line of a command that must fail."""
        assert self(*words) == code
        lines = [line for line in self.err.splitlines() if line.startswith("longarm: ")]
        assert "Traceback" not in self.err
        return lines[-1]


@pytest.fixture
def shell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Shell:
    monkeypatch.chdir(tmp_path)
    return Shell(tmp_path, capsys)


def real(q: np.ndarray) -> np.ndarray:
    """Where the tip really is: joint zeros are off, and 6 mm that geometry cannot explain."""
    share = (q - ARM.mid) / (ARM.upper - ARM.lower)
    bent = np.stack([np.cos(6 * share[:, 1]), np.sin(5 * share[:, 0]), np.cos(5 * share[:, 3])], -1)
    return Model(ARM).tip(q + np.array([0.012, -0.01, 0.001, 0.008])) + 6e-3 * bent


def on_the_real_arm(n: int, rng: np.random.Generator) -> Session:
    session = measured(n, rng)
    noise = session.xyz - Model(ARM).tip(session.q)
    return Session.record(session.q, real(session.q) + noise)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm, sessions measured on it, a model and a predictor, made by the commands."""
    folder = tmp_path_factory.mktemp("work")
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    (folder / "arm.yaml").write_text(yaml.safe_dump(data))
    rng = np.random.default_rng(3)
    write_csv(on_the_real_arm(120, rng), folder / "samples.csv")
    write_csv(on_the_real_arm(30, rng), folder / "test.csv")
    shell = Shell(folder)
    arm, samples = folder / "arm.yaml", folder / "samples.csv"
    model, predictor = folder / "model.yaml", folder / "predictor.npz"
    assert shell("calibrate", arm, samples, "-o", model) == 0
    quick = ("--ensemble", 2, "--hidden", 10)
    assert shell("train", arm, samples, "--model", model, "-o", predictor, *quick) == 0
    return folder


# ------------------------------------------------------------------ the program


def test_help_loads_nothing_heavy() -> None:
    program = (
        "import sys\nfrom longarm_comp.cli.run import run\ncode = run(['--help'])\n"
        f"print([name for name in {HEAVY} if name in sys.modules], code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[] 0"
    for entry in registry.COMMANDS:
        if " " not in entry.name:
            assert f"  {entry.name} " in done.stdout


@pytest.mark.parametrize("entry", registry.COMMANDS, ids=lambda entry: entry.name)
def test_every_command_is_there_and_helps(entry: registry.Entry, shell: Shell) -> None:
    assert shell(*entry.name.split(), "--help") == 0
    assert shell.out.startswith(f"Usage: longarm {entry.name} ")
    assert "Example" in shell.out


def test_small_matrices_get_one_thread_unless_told_otherwise() -> None:
    program = (
        "import os\nfrom longarm_comp.cli.run import run\nrun(['schema'])\n"
        "print(os.environ['OMP_NUM_THREADS'], os.environ['OPENBLAS_NUM_THREADS'])"
    )
    env = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={**env, "OMP_NUM_THREADS": "2"},
    )
    assert done.stdout.splitlines()[-1] == "2 1"


def test_no_file_of_a_command_is_forgotten() -> None:
    folder = Path(run.__file__).parent
    files = {p.stem for p in folder.glob("*.py") if "\ndef command(" in p.read_text("utf-8")}
    assert files == {entry.module for entry in registry.COMMANDS}


def test_unknown_words_leave_with_2(shell: Shell) -> None:
    assert shell("calibrat") == 2
    assert "calibrat" in shell.err
    assert shell("plan", "--kind", "spiral") == 2
    assert shell("calibrate", "arm.yaml") == 2


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command()
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(run, "root", lambda: broken)
    with pytest.raises(ZeroDivisionError):
        run.run([])


def test_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "root", lambda: stopped)
    assert run.run([]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_module_and_program_are_the_same() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "longarm_comp", "compensate", "none.yaml", "1", "2", "3"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("longarm: none.yaml: file: ")
    assert done.stderr.count("\n") == 1


# ------------------------------------------------------------------ what the commands do


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
    assert shell("bag", "from-csv", arm, test, "-o", "bag", "--storage", "sqlite3") == 0
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


def test_compensate_takes_the_error_off(work: Path, shell: Shell) -> None:
    session = read_csv(work / "test.csv", ARM)
    inside = np.abs(session.q - ARM.mid).max(1).argsort()[:5]
    targets = Model(ARM).tip(session.q[inside])
    np.savetxt("targets.csv", targets, delimiter=",", header="x,y,z", comments="")
    command = (
        *("compensate", work / "arm.yaml", "--targets", "targets.csv"),
        *("--model", work / "model.yaml", "-o", "commands.csv"),
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


def test_compensate_one_target_with_its_options(work: Path, shell: Shell) -> None:
    x, y, z = Model(ARM).tip(ARM.mid - np.array([0.3, 0, 0, 0]))
    assert y < 0  # a number with a sign is no option
    seed = ",".join(str(v) for v in ARM.mid - np.array([0.2, 0, 0, 0]))
    made = shell.json(
        "compensate", work / "arm.yaml", x, y, z, "--seed-q", seed, "--lock", "joint4"
    )
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
        *("compensate", work / "arm.yaml", x, y, z, "--lock", 1, "--seed-q"),
        ",".join(str(v) for v in ARM.mid + np.array([0.5, 0, 0, 0])),
        *("--model", work / "model.yaml", "--predictor", "half.npz"),
    )
    (command,) = made["commands"]
    assert command["status"] == "out_of_domain"
    assert "outside" in command["reason"]


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
    assert made["approach"] == [1, -1]
    assert "1 to 3" in shell.refused(*plan, 4)
    assert "--report" in shell.refused("plan", work / "arm.yaml", "--kind", "next", "-n", 2)


def test_import_urdf_and_schema(shell: Shell) -> None:
    Path("r.urdf").write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
        '<parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>'
    )
    assert shell("import-urdf", "r.urdf", "--base", "a", "--tip", "b", "-o", "arm.yaml") == 0
    assert Arm.load("arm.yaml").joint_names == ("j",)
    assert "--tip" in shell.refused("import-urdf", "r.urdf", "--base", "a", "--tip", "z")
    assert shell("schema") == 0
    schema = json.loads(shell.out)
    assert set(schema["properties"]) == set(Arm.model_fields)
    assert schema["additionalProperties"] is False


def test_bench_gives_the_agreed_rows(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def row(name: str) -> dict[str, object]:
        return {"name": name, "value": 2.0, "unit": "us", "peer": "p", "peer_value": 6.0,
                "ratio": 3.0, "spread": [1.0, float("nan")]}  # fmt: skip

    monkeypatch.setattr(catalogue, "run", row)
    made = shell.json("bench")
    assert [r["name"] for r in made["results"]] == list(catalogue.MODULE_OF)
    assert made["results"][0]["spread"] == [1.0, None]
    assert made["machine"]
    assert shell("bench", "ssa_evals_vs_mealpy_300") == 0
    assert "3.000" in shell.out
    assert "ssa_evals_vs_mealpy_900" in shell.refused("bench", "ssa_evals")


def test_every_benchmark_is_where_the_list_says() -> None:
    for name, module in catalogue.MODULE_OF.items():
        assert callable(getattr(importlib.import_module(f"longarm_comp.bench.{module}"), name))


# ------------------------------------------------------------------ bad input


def edited(work: Path, old: str, new: str) -> str:
    """samples.csv with something replaced, in the present folder."""
    text = (work / "samples.csv").read_text()
    assert old in text
    Path("bad.csv").write_text(text.replace(old, new))
    return "bad.csv"


def test_misspelt_column(work: Path, shell: Shell) -> None:
    bad = edited(work, "repeat_id", "repeatid")
    line = shell.refused("calibrate", work / "arm.yaml", bad)
    assert line == (
        "longarm: bad.csv: column repeatid: 'unknown, close to repeat_id'; "
        "allowed: repeat_id, or another name"
    )
    assert not Path("model.yaml").exists()


def test_millimetres_for_metres(work: Path, shell: Shell) -> None:
    session = read_csv(work / "samples.csv", ARM)
    write_csv(Session.record(session.q, 1e3 * session.xyz), "mm.csv")
    for command in (
        ("calibrate", work / "arm.yaml", "mm.csv"),
        ("train", work / "arm.yaml", "mm.csv"),
        ("evaluate", work / "arm.yaml", "--test", "mm.csv"),
    ):
        assert "millimetres" in shell.refused(*command)


def test_one_row_is_enough_to_evaluate_but_not_to_calibrate(work: Path, shell: Shell) -> None:
    write_csv(read_csv(work / "test.csv", ARM).take([0]), "one.csv")
    assert shell("evaluate", work / "arm.yaml", "--test", "one.csv") == 0
    assert "rows: 1" in shell.refused("calibrate", work / "arm.yaml", "one.csv")


def test_corrupt_predictor(work: Path, shell: Shell) -> None:
    whole = (work / "predictor.npz").read_bytes()
    Path("cut.npz").write_bytes(whole[: len(whole) // 2])
    evaluate = ("evaluate", work / "arm.yaml", "--test", work / "test.csv")
    line = shell.refused(*evaluate, "--model", work / "model.yaml", "--predictor", "cut.npz")
    assert "cut.npz" in line


def test_predictor_of_another_model(work: Path, shell: Shell) -> None:
    evaluate = ("evaluate", work / "arm.yaml", "--test", work / "test.csv")
    line = shell.refused(*evaluate, "--predictor", work / "predictor.npz")
    assert "model_hash" in line


def test_model_of_another_arm(work: Path, shell: Shell) -> None:
    text = (work / "arm.yaml").read_text()
    Path("other.yaml").write_text(text.replace("d_m: 0.4", "d_m: 0.41"))
    line = shell.refused("evaluate", "other.yaml", "--test", work / "test.csv", "--model",
                         work / "model.yaml")  # fmt: skip
    assert "arm.hash" in line


def test_model_that_is_not_there(work: Path, shell: Shell) -> None:
    with_predictor = ("--model", "none.yaml", "--predictor", work / "predictor.npz")
    for command in (
        ("train", work / "arm.yaml", work / "samples.csv", "--model", "none.yaml"),
        ("evaluate", work / "arm.yaml", "--test", work / "test.csv", *with_predictor),
        ("compensate", work / "arm.yaml", 0.5, 0, 0.2, *with_predictor),
    ):
        assert shell.refused(*command).startswith("longarm: none.yaml: file: ")


def test_unreachable_target(work: Path, shell: Shell) -> None:
    Path("t.csv").write_text("x,y,z\n9,0,0\n0.5,0,0.2\n")
    line = shell.refused("compensate", work / "arm.yaml", "--targets", "t.csv", code=3)
    assert "target 0: unreachable" in line
    with open("commands.csv", newline="") as file:
        statuses = [row["status"] for row in csv.DictReader(file)]
    assert statuses[0] == "unreachable"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("1", "2"), "target"),
        (("1", "2", "nan"), "target"),
        (("1", "2", "--metod"), "--metod"),
        (("1", "2", "3", "--seed-q", "1,2"), "--seed-q"),
        (("1", "2", "3", "--method", "network"), "--predictor"),
        ((), "X Y Z, or --targets"),
    ],
)
def test_bad_targets(words: tuple[str, ...], said: str, work: Path, shell: Shell) -> None:
    assert said in shell.refused("compensate", work / "arm.yaml", *words)


def test_outputs_that_cannot_be_written(work: Path, shell: Shell) -> None:
    for command in (
        ("calibrate", work / "arm.yaml", work / "samples.csv"),
        ("train", work / "arm.yaml", work / "samples.csv", "--ensemble", 1, "--hidden", 2),
        ("plan", work / "arm.yaml", "--kind", "sobol", "-n", 3),
        ("compensate", work / "arm.yaml", 0.5, 0, 0.2),
        ("bag", "from-csv", work / "arm.yaml", work / "test.csv"),
    ):
        assert "output folder" in shell.refused(*command, "-o", "/proc/longarm/out")


def test_arm_that_is_none(work: Path, shell: Shell) -> None:
    text = (work / "arm.yaml").read_text()
    Path("typo.yaml").write_text(text.replace("convention", "convntion"))
    line = shell.refused("calibrate", "typo.yaml", work / "samples.csv")
    assert "convntion" in line or "convention" in line
