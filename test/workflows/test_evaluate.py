"""`evaluate` judges a model by rows, and a network is used only where it helps."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_shell import Shell
from hidden_arm import at, session, tip
from scipy.spatial.transform import Rotation
from small_arm import ARM

import longarm_comp as la
from longarm_comp.core.data.plan import Plan, outside_boxes, with_floor
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import outline
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sim.hidden.drives import JointGain
from longarm_comp.sim.hidden.geometry import JointZero

QUICK = {"hidden": 3, "ensemble": 1}


def words_of(folder: Path, arm: la.Arm, rows: la.Session) -> tuple[str | Path, ...]:
    """The command that evaluates an arm on rows, with both written to a folder."""
    (folder / "arm.yaml").write_text(arm.model_dump_json(exclude_defaults=True))
    write_csv(rows, folder / "test.csv")
    return "evaluate", folder / "arm.yaml", "--test", folder / "test.csv"


def test_an_outlier_shows_in_the_worst_rows_and_not_in_the_median(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = session(n=40)
    xyz = rows.xyz.copy()
    xyz[7, 2] += 0.06
    numbers = np.arange(100, 140)
    spoiled = la.Session.record(rows.q, xyz, index=numbers)
    shell, words = Shell(tmp_path, capsys), words_of(tmp_path, ARM, spoiled)
    made = shell.json(*words)
    (row,) = made["rows"]
    error = np.linalg.norm(xyz - la.Model(ARM).tip(rows.q), axis=1)
    assert row["median_mm"] == pytest.approx(1e3 * np.median(error), rel=1e-3)
    assert row["max_mm"] == pytest.approx(1e3 * error[7], rel=1e-3)
    assert row["mean_mm"] > 2.0 * row["median_mm"]
    assert made["worst"]["rigid"][0]["index"] == 107
    assert made["worst"]["rigid"][0]["error_mm"] == pytest.approx(row["max_mm"])
    assert shell(*words) == 0
    assert "worst rows of rigid, by index: 107 (6" in shell.err


def test_rows_that_do_not_fit_are_noted_and_counted() -> None:
    """Honest rows, two thirds of them far off for want of an effect, judge the model."""
    q = ARM.lower + np.random.default_rng(2).random((60, ARM.n)) * (ARM.upper - ARM.lower)
    xyz = tip([], q, np.ones(60))
    xyz[::3] += [0.0, 0.0, 0.15]
    rows, notes = la.Session.record(q, xyz), []
    with pytest.raises(la.InputError, match="nothing was changed"):
        la.calibrate(ARM, rows)
    made = la.evaluate(ARM, rows, model=la.Model(ARM), note=notes.append)
    assert made["calibrated"].n == 60
    assert made["calibrated"].mean == pytest.approx(0.05, rel=0.01)
    assert any("far off" in text or "off the arm" in text for text in notes)


def test_an_arm_that_stands_elsewhere_is_judged_and_said() -> None:
    rows, notes = session(n=30), []
    moved = la.Session.record(rows.q, rows.xyz + np.array([0.5, 0.0, 0.0]))
    made = la.evaluate(ARM, moved, model=la.Model(ARM), note=notes.append)
    assert made["calibrated"].mean == pytest.approx(0.5, rel=0.01)
    assert made["rigid"].mean < 1e-3 and made.placed and not made.elsewhere
    assert any("from where the model expects it" in text for text in notes)
    with pytest.raises(la.JobError, match="from where the model expects it"):
        la.train(ARM, moved, model=la.Model(ARM), **QUICK)


@pytest.mark.parametrize("group", ["", "c"])
def test_rows_of_a_place_that_the_model_does_not_know_are_said_to_be(group: str) -> None:
    rows, notes = session(n=30), []
    bases = (BasePose(group="a", x=1.0), BasePose(group="b", x=-1.0))
    xyz = rows.xyz + np.array([0.5, 0.0, 0.0])
    moved = replace(rows, xyz=xyz, labels={"group": np.full(30, group)} if group else {})
    la.evaluate(ARM, moved, model=la.Model(ARM, bases), note=notes.append)
    said = r"name in a column group where the base stood \(a, b\), or calibrate first"
    assert any(re.search(said, text) for text in notes), notes
    with pytest.raises(la.JobError, match=said):
        la.train(ARM, moved, model=la.Model(ARM, bases), **QUICK)


@pytest.mark.parametrize(
    ("poses", "markers", "repeats"), [(1, 3, 3), (3, 3, 1), (1, 1, 9), (5, 1, 1), (5, 1, 2)]
)
def test_rows_that_hardly_tell_more_than_a_place_judge_nothing(
    poses: int, markers: int, repeats: int, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], rng: np.random.Generator,
) -> None:  # fmt: skip
    """Base and three markers are 15 numbers, base and tip 9: rows that hold no more fit exactly."""
    several = {
        f"m{k}": {"frame": 4, "position_m": [0.05 * k, 0.02 * k, 0.1]} for k in range(markers)
    }
    named = several if markers > 1 else {}
    arm = la.Arm.parse(ARM.model_dump(exclude_defaults=True) | {"markers": named}, "arm")
    spots = [name for name in (named or {"": 0}) for _ in range(poses)]
    q = np.tile(ARM.lower + rng.random((poses, ARM.n)) * (ARM.upper - ARM.lower), (markers, 1))
    blank = la.Session.record(q, np.zeros((len(q), 3)), labels={"marker": np.array(spots)})
    xyz = la.Model(arm).measured(q, blank.context()) + 0.5 + 0.02 * rng.standard_normal((len(q), 3))
    q, xyz, spots = np.tile(q, (repeats, 1)), np.tile(xyz, (repeats, 1)), spots * repeats
    xyz += 1e-5 * rng.standard_normal(xyz.shape)
    rows = la.Session.record(q, xyz, labels={"marker": np.array(spots)} if named else {})
    shell, words = Shell(tmp_path, capsys), words_of(tmp_path, arm, rows)
    assert shell.json(*words)["rows"][0]["mean_mm"] == pytest.approx(500.0 * 3**0.5, rel=0.1)
    assert shell(*words) == 0 and "it is judged where it is declared" in shell.err


def test_orientations_alone_have_no_worst_rows(rng: np.random.Generator) -> None:
    q = ARM.lower + rng.random((12, ARM.n)) * (ARM.upper - ARM.lower)
    turns = Rotation.from_matrix(la.Model(ARM).pose(q)[:, :3, :3]).as_quat()
    rows = la.Session.record(q, np.full((12, 3), np.nan), readings={"orientation": turns})
    made = la.evaluate(ARM, rows)
    assert made["rigid"].angle == pytest.approx(0.0, abs=1e-6) and made.notes == []


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"n": -1}, r"plan: n: -1; allowed: 1 to 1048576"),
        ({"n": 0, "kind": "grid"}, r"plan: n: 0; allowed: 1 to 81"),
        ({"n": 3, "kind": "best"}, r"kind: 'best'; allowed: grid, sobol, next, i-optimal"),
    ],
)
def test_a_plan_says_what_it_may_be(how: dict[str, Any], said: str) -> None:
    with pytest.raises(la.InputError, match=said):
        la.plan(ARM, **how)


def test_touched_points_are_no_place_of_the_arm(rng: np.random.Generator) -> None:
    """Three points, touched twice each, are 9 numbers more than they take, and the tip is 3."""
    q = ARM.lower + rng.random((6, ARM.n)) * (ARM.upper - ARM.lower)
    points = {"touch": np.array(["a", "b", "c"] * 2)}
    made = la.evaluate(ARM, la.Session.record(q, np.full((6, 3), np.nan), labels=points))
    assert made.placed and not made.elsewhere and made["rigid"].spread > 0.01


def test_a_network_that_does_not_help_is_not_written(tmp_path: Path) -> None:
    made = la.train(ARM, session(n=60), model=la.Model(ARM), **QUICK)
    assert not made.gain.helps
    with pytest.raises(la.JobError, match="physics alone") as said:
        made.save(tmp_path / "p.npz")
    assert f"{1e3 * made.gain.without:.3f} mm" in str(said.value)
    assert not (tmp_path / "p.npz").exists()
    found = la.evaluate(ARM, session(n=60), model=la.Model(ARM), predictor=made)
    assert found.outside == 0 and found.refused == 60
    assert found["network"].mean == found["calibrated"].mean


def test_one_that_helps_is_written_and_has_its_rows_in_its_data(tmp_path: Path) -> None:
    bent = [JointZero(at(1, 0.02)), JointGain(at(2, 0.05))]
    rows = session(bent, n=80)
    made = la.train(ARM, rows, model=la.Model(ARM), **QUICK)
    made.save(tmp_path / "p.npz")
    found = la.evaluate(ARM, rows, model=la.Model(ARM), predictor=made)
    assert found.outside == 0 and found.refused < 8
    assert found["network"].mean < 0.5 * found["calibrated"].mean


def test_a_floor_above_the_foot_is_risen_above_once(rng: np.random.Generator) -> None:
    turned = {"base": {"rpy_deg": [180, 0, 0]}}
    upright = la.Arm.parse({**ARM.model_dump(exclude_defaults=True), **turned}, "arm")
    model = declared_model(upright)
    q = ARM.lower + rng.random((60, ARM.n)) * (ARM.upper - ARM.lower)
    lines = outline(model, q)
    for height in (-0.2, 0.05, float(np.median(lines[:, -1, 2]))):
        floor = declared_model(with_floor(upright, height))
        plan = Plan(q, np.zeros_like(q))
        free = outside_boxes(floor, plan)
        risen = np.maximum.accumulate(lines[..., 2] > height, axis=1)
        stays = ((lines[..., 2] > height) | ~risen).all(axis=1) & (lines[:, -1, 2] > height)
        np.testing.assert_array_equal(free, stays)
        assert free.any()
    assert not free.all()
    for wrong in (np.inf, -np.inf, np.nan):
        with pytest.raises(la.InputError, match="a height"):
            with_floor(ARM, wrong)


def test_training_that_does_not_help_ends_well_without_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arm.yaml").write_text(ARM.model_dump_json(exclude_defaults=True))
    write_csv(session(n=60), "samples.csv")
    shell = Shell(tmp_path, capsys)
    words = ("train", "arm.yaml", "samples.csv", "-o", "p.npz", "--ensemble", 1, "--hidden", 3)
    made = shell.json(*words)
    assert made["output"] is None and not Path("p.npz").exists()
    left = made["left_out_mean_mm"]
    assert shell(*words) == 0
    better = left["after"] < left["before"]
    why = "the gain may be chance" if better else "the physics alone is as good"
    assert f"not written: {why}" in shell.err
    assert f"{left['before']:.3f} mm" in shell.err and f"{left['after']:.3f} mm" in shell.err
