"""`longarm fleet`: arms in folders or in one, the newest session, drift, what is the kind's."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from few_effects import few_effects
from fleet_arms import arm_yaml, rows_of
from hidden_arm import at, session
from report_pages import Page
from small_arm import measured

import longarm_comp as la
from longarm_comp.cli.diagnose import fleet as command
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.report.pages import fleet_page
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sim.hidden.drives import JointGain
from longarm_comp.workflows import fleet as workflow
from longarm_comp.workflows.diagnose import DiagnosisResult, diagnose_files
from longarm_comp.workflows.fleet import Diagnosed, FleetFinding, compare_arms, fleet, list_members
from studies.fleet import command as study


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two arms with their model in use; one was knocked since, and one has a broken session."""
    root = tmp_path_factory.mktemp("arms")
    for name, now in (("sound", 0.002), ("knocked", 0.012)):
        arm_yaml(root / name)
        arm = la.Arm.load(root / name / "arm.yaml")
        write_csv(rows_of(0.002, 3, n=40), root / name / "first.csv")
        la.calibrate(arm, root / name / "first.csv").save(root / name / "model.yaml")
        write_csv(rows_of(now, 7, n=40), root / name / "later.csv")
        os.utime(root / name / "first.csv", (1e9, 1e9))
        (root / name / "commands.csv").write_text("index,status,q1,x\n0,ok,0,0\n", encoding="utf-8")
    arm_yaml(root / "broken")
    (root / "broken" / "rows.csv").write_text(
        "q1,q2,q3,q4,x,y,z\n1,2,3,4,5,6,7\n", encoding="utf-8"
    )
    return root


@pytest.fixture(scope="module")
def told(folders: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """What `longarm fleet` wrote of the arms, and what it printed.

    In one process, of few names; test_no_code_from_data.py has it in two.
    """
    out = tmp_path_factory.mktemp("out")
    words = [str(folders), "-o", str(out), "--no-network", "--jobs", "1", "--json"]
    with few_effects():
        done = CliRunner().invoke(command, words)
    assert done.exit_code == 0, (done.output, done.exception)
    return out, done.stdout


def test_the_arm_that_was_knocked_is_told(folders: Path, told: tuple[Path, str]) -> None:
    found = {m.name: m.session.name for m in list_members(folders)}
    assert found == {"broken": "rows.csv", "knocked": "later.csv", "sound": "later.csv"}
    out, printed = told
    arms = {row["name"]: row for row in json.loads(printed)["arms"]}
    assert {name: row["drifted"] for name, row in arms.items()} == {
        "broken": False, "knocked": True, "sound": False,
    }  # fmt: skip
    assert arms["broken"]["verdict"] == "failed"
    assert "rows.csv" in arms["broken"]["summary"]
    assert arms["knocked"]["in_use_mm"] > 4.0 > 0.5 > arms["knocked"]["calibrated_mm"]
    assert arms["sound"]["kind"] == arms["knocked"]["kind"]
    assert (out / "sound" / "report.html").is_file()
    page = Page((out / "fleet.html").read_text("utf-8"))
    words = page.words()
    assert not page.faults and "3 arms: 1 drifted, 1 could not be diagnosed" in words
    assert "2 of them have a model.yaml in use" in words
    wrong = arms["knocked"]["in_use_mm"]
    assert f"knocked : the model in use errs by {wrong:.2f} mm" in words and "sound :" not in words
    links = [a["href"] for a in page.all("a") if "report" in str(a["href"])]
    assert links == ["knocked/report.html", *(f"{n}/report.html" for n in ("knocked", "sound"))]
    assert json.loads((out / "fleet.json").read_text("utf-8"))["arms"] == list(arms.values())


@pytest.mark.usefixtures("few_names")
def test_a_cause_without_a_name_is_told_with_its_place_and_size(tmp_path: Path) -> None:
    arm_yaml(tmp_path / "arms" / "shaken")
    pump = np.random.default_rng(5).uniform(1.0, 2.0, 100)
    rows = measured(100, np.random.default_rng(4), columns={"pump_bar": pump})
    sway = 2e-3 * np.sin(6.0 * pump)
    shaken = dataclasses.replace(rows, xyz=rows.xyz + np.outer(sway, [1.0, 0.0, 0.0]))
    write_csv(shaken, tmp_path / "arms" / "shaken" / "rows.csv")
    (arm,) = fleet(tmp_path / "arms", tmp_path / "out", network=False)
    (found,) = arm.findings
    assert (found.effect, found.where) == ("cause without a name", "base, move x")
    assert found.tip_mm == pytest.approx(1e3 * sway.std(), rel=0.1)


def test_one_arm_yaml_stands_for_arms_of_a_kind(folders: Path, tmp_path: Path) -> None:
    arm_yaml(tmp_path)
    shutil.copy(folders / "sound" / "first.csv", tmp_path / "one.csv")
    shutil.copy(folders / "sound" / "later.csv", tmp_path / "two.csv")
    assert [(m.name, m.arm.parent) for m in list_members(tmp_path)] == [
        ("one", tmp_path), ("two", tmp_path),
    ]  # fmt: skip


def test_what_most_arms_of_a_kind_have_is_the_kinds() -> None:
    def arm(name: str, kind: int, *found: str) -> Diagnosed:
        size = "abcd".index(name) + 1.0
        mine = tuple(FleetFinding(effect, "joint 2", size) for effect in found)
        return Diagnosed(name, kind, "s", 10, "named", "", findings=mine)

    arms = compare_arms([
        arm("a", 0, "play", "give"), arm("b", 0, "play"), arm("c", 0), arm("d", 3, "give"),
    ])  # fmt: skip
    told = {(a.name, f.effect): f.of_kind for a in arms for f in a.findings}
    assert told == {
        ("a", "play"): True,
        ("a", "give"): False,
        ("b", "play"): True,
        ("d", "give"): False,
    }
    page = Page(fleet_page("hall", [a.row for a in arms]))
    assert page.tables["kind"][1:] == [["play", "joint 2", "2 of 3", "1.50", "1.00", "2.00"]]
    own = [row[-1] for row in page.tables["arms"][1:]]
    assert own == ["give at joint 2 (1.00 mm)", "–", "–", "give at joint 2 (4.00 mm)"]
    assert "without a model in use drift is not known" in page.words()


def test_folders_without_arms_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fleet: 'no arm'"):
        list_members(tmp_path)
    arm_yaml(tmp_path / "bare")
    with pytest.raises(InputError, match="bare: session: 'none'"):
        list_members(tmp_path)
    (tmp_path / "bare" / "rows.csv").write_text("q1,x\n1,2\n", encoding="utf-8")
    done = CliRunner().invoke(command, [str(tmp_path), "-o", str(tmp_path / "out")])
    assert isinstance(done.exception, JobError)


@pytest.mark.usefixtures("few_names")
def test_its_figure_of_a_diagnosis_is_that_of_the_model_which_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fuller model that failed its proof is in the report's table, and in no file."""

    def proof_fails(*files: Any, **how: Any) -> DiagnosisResult:
        made = diagnose_files(*files, **how)
        return dataclasses.replace(
            made, diagnosis=dataclasses.replace(made.diagnosis, written="calibrated")
        )

    arm_yaml(tmp_path / "arms" / "one")
    write_csv(session((JointGain(at(2, 0.02)),)), tmp_path / "arms" / "one" / "rows.csv")
    (named,) = fleet(tmp_path / "arms", tmp_path / "out", network=False)
    assert named.diagnosed_mm and named.calibrated_mm
    assert named.diagnosed_mm < 0.8 * named.calibrated_mm
    monkeypatch.setattr(workflow, "diagnose_files", proof_fails)
    (failed,) = fleet(tmp_path / "arms", tmp_path / "again", network=False)
    assert failed.diagnosed_mm == failed.calibrated_mm == named.calibrated_mm


@pytest.mark.usefixtures("few_names")
def test_it_diagnoses_again_what_was_told_beside_a_session_or_is_gone(
    folders: Path, tmp_path: Path
) -> None:
    seen: list[str] = []

    def run() -> list[str]:
        seen.clear()
        fleet(tmp_path, tmp_path / "out", network=False, progress=lambda name, _: seen.append(name))
        return seen

    shutil.copytree(folders / "sound", tmp_path / "sound")
    assert run() == ["sound"]
    assert run() == []
    (tmp_path / "sound" / "touches.yaml").write_text("touch_distances: []\n", encoding="utf-8")
    assert run() == ["sound"]
    shutil.rmtree(tmp_path / "out" / "sound")
    assert run() == ["sound"]


@pytest.mark.usefixtures("few_names")
def test_it_goes_on_where_it_was_ended(
    folders: Path, told: tuple[Path, str], tmp_path: Path
) -> None:
    """Beside the first call: what failed is tried again, what was done is not."""
    arms, out = tmp_path / "arms", tmp_path / "out"
    shutil.copytree(folders, arms)
    shutil.copytree(told[0], out)
    seen: list[str] = []

    def run() -> list[Diagnosed]:
        seen.clear()
        return fleet(arms, out, network=False, progress=lambda name, share: seen.append(name))

    first = run()
    assert seen == ["broken"]
    shutil.rmtree(arms / "broken")
    assert run() == first[1:] and seen == []
    write_csv(rows_of(0.002, 11, n=40), arms / "knocked" / "later.csv")
    again = run()
    assert seen == ["knocked"]
    assert again[1] == first[2] and again[0].made_of != first[1].made_of
    shutil.rmtree(arms / "knocked")
    (out / "fleet.json").write_text("{", encoding="utf-8")
    (one,) = run()
    assert seen == ["sound"]
    assert dataclasses.replace(one, session=first[2].session, kind=first[2].kind) == first[2]


def test_a_diagnosis_that_breaks_ends_no_other(
    folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(arm: object, session: Path, *_: object, **__: object) -> None:
        raise ZeroDivisionError(session.parent.name)

    monkeypatch.setattr("longarm_comp.workflows.fleet.diagnose_files", breaks)
    told = fleet(folders, tmp_path, network=False)
    assert [a.summary for a in told] == [
        f"a fault of longarm: ZeroDivisionError('{name}')"
        for name in ("broken", "knocked", "sound")
    ]
    assert {a.verdict for a in told} == {"failed"}


def test_a_process_that_is_killed_ends_the_call_with_advice() -> None:
    """As on a machine without memory; what was diagnosed is in fleet.json already."""
    killed: Any = [(1,)]
    before = dict(os.environ)
    with pytest.raises(JobError, match=r"a process was killed.*fewer --jobs"):
        list(workflow._diagnose_each(os._exit, killed, 2, None))
    assert dict(os.environ) == before, "what its processes are told stays with them"


@pytest.mark.long
def test_simulated_arms_of_one_kind(tmp_path: Path) -> None:
    """Three arms of the study; it goes on from the first two."""
    words = ["--arms", "3", "--arms", "2", "-o", str(tmp_path), "--json"]
    done = CliRunner().invoke(study, words)
    assert done.exit_code == 0, (done.output, done.exception)
    two, three = json.loads(done.stdout)["fleets"]
    assert (two["arms"], three["arms"], three["failed"]) == (2, 3, 0)
    assert three["kind_found"] >= 0.6  # on the first arm it is 88 % probable: in doubt
    assert any("joint 2" in name for name in three["of_kind"])
    assert three["diagnosed_mm"] < 0.3 * three["calibrated_mm"]
    assert three["peak_mb"] >= two["peak_mb"] > 50
