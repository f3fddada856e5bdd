"""Benchmarks in small: each runs, gives finite figures, and says what it cannot measure."""

import importlib.util
import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from matplotlib import image
from places import ROOT

from bench import (
    arms,
    bags,
    calibration,
    catalogue,
    comparison,
    diagnosis,
    node_start,
    plot,
    ssa_scaling,
    ssa_training,
    startup,
    subprocess_cost,
)
from bench.smooth import smooth_set
from longarm_comp.cli import registry
from longarm_comp.cli.run import run
from longarm_comp.core.errors import InputError, JobError


def finite(row: Any) -> Any:
    """A row with a peer: every figure is a positive number."""
    numbers = [row["value"], row["peer_value"], row["ratio"], *row["spread"]]
    assert all(math.isfinite(v) and v > 0 for v in numbers), row
    assert row["spread"][0] <= row["ratio"] <= row["spread"][1]
    assert row["unit"] and row["peer"]
    return row


def test_ratios_above_one_are_ahead() -> None:
    quicker = finite(comparison.beside("s", [1.0, 2.0], "p", [4.0, 4.0]))
    assert (quicker["ratio"], quicker["spread"]) == (3.0, [2.0, 4.0])
    faster = finite(comparison.beside("1/s", [8.0], "p", [2.0], more_is_better=True))
    assert faster["ratio"] == 4.0
    assert comparison.missing("p", "why")["ratio"] is None
    assert comparison.alone("s", [1.0, 3.0], "note")["spread"] == [1.0, 3.0]


# ------------------------------------------------------------------ in a process of its own


def test_memory_counts_what_the_call_took() -> None:
    one, big = (
        subprocess_cost.cost_of("builtins", "eval", f"len(b'x' * ({mb} * 2**20))")
        for mb in (1, 200)
    )
    assert (one.result, big.result) == (2**20, 200 * 2**20)
    assert big.grown_mb - one.grown_mb == pytest.approx(199, abs=5)
    assert big.peak_mb > big.grown_mb
    assert 0 <= one.cpu_s < 60


def test_a_call_that_fails_is_a_job_that_failed() -> None:
    with pytest.raises(JobError, match="fit_once"):
        subprocess_cost.cost_of("bench.calibration", "fit_once", 40, "no such arm")


# ------------------------------------------------------------------ each kind in small


def test_calibration_against_scipy() -> None:
    row = finite(calibration.beside_scipy(60, 1, rigid=True))
    assert row["held_out_mm"] == pytest.approx(row["peer_held_out_mm"], rel=0.05)


def test_calibration_against_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own, wherever the command is run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    row = calibration.against_samples(40)
    assert row["us_per_sample_and_step"] > 0
    assert row["value"] > 0
    assert "51 parameters" in str(row["note"])


def test_a_made_session_is_what_its_name_says() -> None:
    arm = arms.demo_arm()
    session = calibration.synthetic_session(arm, 100, seed=2)
    assert session.q.shape == (100, arm.n)
    assert (session.q >= arm.lower).all()
    assert (session.q <= arm.upper).all()
    again = calibration.synthetic_session(arm, 100, seed=2)
    assert again.hash == session.hash
    assert calibration.synthetic_session(arm, 100, seed=3).hash != session.hash


@pytest.mark.long
def test_diagnosis_runs_with_a_part_of_the_library() -> None:
    made = diagnosis.diagnose_once(40, kinds=2)
    assert made["cpu_s"] > 0
    assert made["candidates"] > 0
    assert made["verdict"] in ("noise", "named", "set", "partly", "unknown")


def test_bags_read_and_written() -> None:
    finite(bags.read("rosbags", 500, 1))
    finite(bags.record(500, 1))
    if importlib.util.find_spec("mcap_ros2"):
        finite(bags.read("mcap", 500, 1))
    row = finite(bags.read_large(6_000_000))
    assert row["messages_per_s"] > 0
    assert row["value"] < 100


def test_a_full_disk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr(bags.shutil, "disk_usage", lambda _: usage)
    assert bags.read_large()["ratio"] is None


@pytest.mark.long
def test_training_to_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ssa_training.LADDERS, "mlp", (("2 hidden", ssa_training._mlp(2)),))
    row = finite(ssa_training.time_to_error("mlp", 60, target_mm=3.0, repeats=1))
    assert row["rms_mm"] <= 3.0
    assert row["peer_rms_mm"] <= 3.0
    never = ssa_training.time_to_error("mlp", 60, target_mm=1e-9, repeats=1)
    assert never["ratio"] is None
    assert "does not reach" in str(never["note"])


@pytest.mark.long
def test_ssa_against_samples_and_population() -> None:
    assert ssa_scaling.search_rate(100, 20, 2) > 0
    row = finite(ssa_scaling.train_many(120, 60))
    assert row["rms_mm"] > 0
    assert smooth_set(60, 0).q.shape == (60, 7)


def test_commands_and_imports_start() -> None:
    for name in ("help", "core"):
        finite(startup.beside_floor(name, 1))


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="no ROS")
def test_every_node_comes_up(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    found = node_start.ready_times(1, warm=False)
    monkeypatch.setattr(node_start, "ready_times", lambda: found)
    started = [n for n, (at, *_) in catalogue.BENCHMARKS["startup"].items() if "node_start" in at]
    assert len(started) == 5
    for name in started:
        finite(catalogue.run(name))


# ------------------------------------------------------------------ the command


def fake(name: str) -> dict[str, object]:
    if name == "ssa_evals_vs_mealpy_300":
        raise JobError("no network")
    if name == "ssa_train_100000":
        return {"name": name, **comparison.missing("numpy", "no CUDA device here")}
    return {"name": name, **comparison.beside("us", [2.0, 1.0], "p", [5.0, 6.0])}


def test_results_as_json_and_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue, "run", fake)
    assert run(["bench", "ssa", "bags", "-o", str(tmp_path / "out")]) == 0
    made = json.loads((tmp_path / "out" / "results.json").read_text())
    names = [row["name"] for row in made["results"]]
    assert names == [n for n, kind in catalogue.KIND_OF.items() if kind in ("ssa", "bags")]
    assert set(made) == {"machine", "libraries", "load", "results"}
    assert "Python" in made["machine"]
    assert "no network" in made["results"][0]["note"]
    assert made["results"][1]["ratio"] == pytest.approx(4.25)
    picture = image.imread(tmp_path / "out" / "results.png")
    assert picture.shape[0] > 300
    assert picture.std() > 0.05  # not blank


def test_a_picture_without_any_ratio(tmp_path: Path) -> None:
    plot.draw([fake("ssa_train_100000")], "title", tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_folder_that_cannot_be_is_refused_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(name: str) -> dict[str, object]:
        raise AssertionError(name)

    monkeypatch.setattr(catalogue, "run", never)
    (tmp_path / "file").write_text("")
    assert run(["bench", "-o", str(tmp_path / "file" / "out")]) == 2


def test_what_there_is_can_be_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "bags", "--list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert {row["kind"] for row in listed} == {"bags"}
    with pytest.raises(InputError):
        catalogue.run("nothing")


def test_outside_of_a_checkout_the_command_says_where_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No benchmarks beside the package: one line, whatever the folder holds it is run in."""
    monkeypatch.setattr(registry, "__file__", str(tmp_path / "a" / "b" / "c" / "registry.py"))
    monkeypatch.setattr(sys, "path", [*sys.path])
    for folder in (tmp_path, ROOT):
        monkeypatch.chdir(folder)
        assert run(["bench", "--list"]) == 3
        assert "run from a checkout of the project" in capsys.readouterr().err
