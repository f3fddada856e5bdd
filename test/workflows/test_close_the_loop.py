"""From file to file and round again: measure what splits a set, learn what has no name."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hidden_arm import at, session, tip, white
from loaded_arm import arm_data
from small_arm import ARM

from longarm_comp.cli.run import run
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model_file import load_model
from longarm_comp.sessions.csv import read_csv, write_csv
from longarm_comp.sessions.poses import read_poses
from longarm_comp.sim.hidden import drives
from longarm_comp.workflows.diagnose import DiagnosisResult


def longarm(*words: object) -> int:
    return run([str(word) for word in words])


def report(folder: Path) -> dict[str, Any]:
    made: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return made


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.yaml"
    path.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_defaults=True)))
    return path


@pytest.mark.usefixtures("few_names")
def test_the_poses_that_are_asked_for_split_the_set(arm: Path, tmp_path: Path) -> None:
    hidden = [drives.JointGain(at(2, 0.02))]
    samples, plan, out = tmp_path / "samples.csv", tmp_path / "poses.csv", tmp_path / "diagnosis"
    write_csv(session(hidden, n=120, levels=3), samples)
    assert longarm("diagnose", arm, samples, "--no-network", "-o", out) == 0
    first = report(out)
    assert first["verdict"] == "set"
    assert {"joint_gain", "gear_eccentricity"} <= set(first["findings"][0]["set"])

    assert longarm("plan", arm, "--kind", "next", "-n", 12, "--report", out, "-o", plan) == 0
    asked = read_poses(plan, ARM)
    assert np.array_equal(asked.q, read_poses(out / "next_poses.csv", ARM).q[:12])
    assert (asked.approach == asked.approach[:, :1]).all()  # all joints from one side
    side = asked.approach[:, 0].astype(float)
    assert set(side) <= {-1.0, 1.0}
    reached = tip(hidden, asked.q, side) + white(np.random.default_rng(3), len(asked))
    known = read_csv(samples, ARM)
    sides = np.repeat(side[:, None], ARM.n, axis=1)
    write_csv(
        Session.record(
            np.concatenate([known.q, asked.q]),
            np.concatenate([known.xyz, reached]),
            approach=np.concatenate([known.approach, sides]),
        ),
        samples,
    )
    assert longarm("diagnose", arm, samples, "--no-network", "-o", out) == 0
    second = report(out)
    assert second["verdict"] == "named"
    assert [f["effect"] for f in second["findings"]] == ["joint_gain"]


@pytest.mark.long
@pytest.mark.usefixtures("few_names")
def test_what_has_no_name_is_found_and_written_to_the_model(arm: Path, tmp_path: Path) -> None:
    span = float(ARM.upper[0] - ARM.lower[0])
    bump = [drives.CoggingBump(0, float(ARM.mid[0]), 0.12 * span, 8e-3)]
    samples, test, out = (tmp_path / n for n in ("samples.csv", "test.csv", "diagnosis"))
    write_csv(session(bump, n=160), samples)
    write_csv(session(bump, n=60, seed=5), test)
    assert longarm("diagnose", arm, samples, "--test", test, "--no-network", "-o", out) == 0
    made = report(out)
    assert made["verdict"] in ("unknown", "partly")
    assert any("q1" in one["formula"] for one in made["discovered"])
    rows = {row["model"]: row for row in made["held_out"]["rows"]}
    assert rows["with_functions"]["mean_mm"] < 0.7 * rows["with_effects"]["mean_mm"]

    model, held = load_model(out / "model.yaml", ARM), read_csv(test, ARM)
    left = 1e3 * np.linalg.norm(held.xyz - model.measured(held.q, held.context()), axis=1).mean()
    assert left == pytest.approx(rows["with_functions"]["mean_mm"], rel=1e-6)


def test_nineteen_poses_are_too_few(
    arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_csv(session([drives.JointGain(at(2, 0.02))], n=19), tmp_path / "rows.csv")
    assert longarm("diagnose", arm, tmp_path / "rows.csv", "-o", tmp_path / "out") != 0
    assert "at least 20 distinct poses" in capsys.readouterr().err
    assert report(tmp_path / "out")["verdict"] == "bad_data"


def test_further_poses_are_asked_for_with_a_mass_that_others_are_measured_with(
    tmp_path: Path,
) -> None:
    """A mean of the masses would be a third mass that nobody has."""
    arm = Arm.parse({**arm_data(), "payload": {"frame": 4, "mass_kg": 0.5}}, "loaded")
    some, more = sobol(arm, 4, 1), sobol(arm, 2, 2).q
    split = replace(some, payload_kg=np.array([0.0, 2.0, 0.0, 2.0]))
    found = SimpleNamespace(diagnosis=SimpleNamespace(splits=(split,), next_q=more))
    assert DiagnosisResult._write_next(found, tmp_path / "next.csv")  # type: ignore[arg-type]
    asked = read_poses(tmp_path / "next.csv", arm)
    assert asked.payload_kg is not None
    assert asked.payload_kg.tolist() == [0.0, 2.0, 0.0, 2.0, 2.0, 2.0]
