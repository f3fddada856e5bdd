"""Effects of others: a file, a package, a program; searched, saved, loaded and used like ours."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from few_effects import few_effects, names_alone
from hidden_arm import at, session
from places import ROOT

from longarm_comp.cli.run import run
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.effects import catalogue
from longarm_comp.core.effects.catalogue import BUILT_IN, load_file
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import load_model, save_model, store
from longarm_comp.sessions.csv import read_csv
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import drives
from studies.many import compensate_arrays

EXAMPLE = ROOT / "examples" / "custom_effect.py"
GAIN = (drives.JointGain(at(2, 0.02)),)


pytestmark = pytest.mark.usefixtures("catalogue_of_ours")


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the page docs/add_an_effect.md works in, its diagnosis included."""
    folder = tmp_path_factory.mktemp("cable")
    made = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "custom_effect_session.py"), str(folder)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    words = ("diagnose", folder / "arm.yaml", folder / "samples.csv", "--test", folder / "test.csv")
    options = ("--no-network", "--effects", EXAMPLE, "-o", folder / "diagnosis")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(catalogue, "_others", {})
        with few_effects((JointGain,)), names_alone():
            assert run([str(word) for word in (*words, *options)]) == 0
    return folder


# ------------------------------------------------------------------ the example, from end to end


def test_an_effect_of_a_file_is_named_at_its_own_place(example: Path) -> None:
    report = json.loads((example / "diagnosis" / "report.json").read_text())
    assert report["verdict"] == "named"
    (finding,) = report["findings"]
    assert (finding["effect"], finding["where"]) == ("cable_coupling", ["joint 5, driver 2"])
    (gain,) = finding["parameters"]
    assert gain["ci95"][0] < 0.03 < gain["ci95"][1]
    rows = {row["model"]: row["mean_mm"] for row in report["held_out"]["rows"]}
    assert rows["with_effects"] < 0.5 * rows["calibrated"]
    page = (example / "diagnosis" / "report.html").read_text()
    assert "cable_coupling" in page
    assert "q2" in page
    assert "file custom_effect.py" in page


@pytest.mark.long
def test_without_it_the_structure_says_what_to_write(example: Path) -> None:
    arm = Arm.load(example / "arm.yaml")
    seen, test = (read_csv(example / f"{name}.csv", arm) for name in ("samples", "test"))
    found = diagnose(arm, seen, test=test)
    assert found.verdict in ("partly", "unknown")
    (cause,) = found.causes
    assert "q2" in cause.inputs and any("joint 5" in where for where in cause.where)


def test_its_places_are_one_family(demo_arm_path: Path) -> None:
    arm = Arm.load(demo_arm_path)
    (kind,) = load_file(EXAMPLE)
    known = list_candidates(arm, session().context(), (kind,))
    sizes = [len(c.terms) for c in known.testable]
    assert sizes == [1] * 10 + [10]
    assert all(c.form == () for c in known.testable)
    assert known.testable[0].label == "cable_coupling (joint 2, driver 1)"


def test_without_its_file_a_model_is_refused_and_says_which(example: Path) -> None:
    with pytest.raises(InputError, match=r"'cable_coupling'.*file custom_effect\.py.*--effects"):
        load_model(example / "diagnosis" / "model.yaml", Arm.load(example / "arm.yaml"))


def test_a_model_file_never_runs_code(example: Path, tmp_path: Path) -> None:
    trap = tmp_path / "trap.py"
    trap.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    data = yaml.safe_load((example / "diagnosis" / "model.yaml").read_text())
    data["provenance"]["cable_coupling_from"] = f"file {trap}"
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=r"trap\.py"):
        load_model(tmp_path / "model.yaml", Arm.load(example / "arm.yaml"))
    assert not (tmp_path / "ran").exists()


@pytest.mark.long
def test_with_its_file_the_real_tip_lands_on_targets(example: Path) -> None:
    sys.path.insert(0, str(ROOT / "examples"))
    try:
        from custom_effect_session import CablePull
    finally:
        sys.path.pop(0)
    load_file(EXAMPLE)
    arm = Arm.load(example / "arm.yaml")
    model = load_model(example / "diagnosis" / "model.yaml", arm)
    q = np.random.default_rng(5).uniform(arm.lower, arm.upper, (30, arm.n))
    targets = TrueArm(arm).tip(q)
    missed = {}
    without = Model(arm, tuple(e for e in model.effects if e.name != "cable_coupling"))
    for name, used in (("with", model), ("without", without)):
        command = compensate_arrays(used, None, targets, seed=q, position_only=True).command
        tip = TrueArm(arm, [CablePull()]).tip(command)
        missed[name] = float(np.linalg.norm(tip - targets, axis=1).mean())
    assert missed["with"] < 3e-4
    assert missed["with"] < 0.2 * missed["without"]


@pytest.mark.parametrize(
    "command",
    [
        *("calibrate", "evaluate", "effects"),
        *(pytest.param(name, marks=pytest.mark.long) for name in ("compensate", "train")),
    ],
)
def test_commands_take_the_file(example: Path, tmp_path: Path, command: str) -> None:
    arm, model = example / "arm.yaml", example / "diagnosis" / "model.yaml"
    words: dict[str, tuple[object, ...]] = {
        "calibrate": (arm, example / "samples.csv", "--effect", "cable_coupling"),
        "evaluate": (arm, "--test", example / "test.csv", "--model", model),
        "compensate": (arm, 1.0, 0.0, 0.2, "--position-only", "--model", model),
        "train": (arm, example / "samples.csv", "--model", model, "--ensemble", 1, "--hidden", 4),
        "effects": (),
    }
    output = () if command in ("evaluate", "effects") else ("-o", tmp_path / "made")
    call = [command, *map(str, (*words[command], *output))]
    assert run(call) == (0 if command == "effects" else 2)
    assert run([*call, "--effects", str(EXAMPLE)]) == 0


def test_the_table_says_where_an_effect_is_from(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["effects", "--json", "--effects", str(EXAMPLE)]) == 0
    rows = {row["effect"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["cable_coupling"]["from"] == "file custom_effect.py"
    assert {row["from"] for name, row in rows.items() if name in BUILT_IN} == {"longarm_comp"}


def test_an_unknown_place_of_its_own_is_refused(example: Path, tmp_path: Path) -> None:
    load_file(EXAMPLE)
    data = yaml.safe_load((example / "diagnosis" / "model.yaml").read_text())
    entry = next(e for e in data["effects"] if e["effect"] == "cable_coupling")
    entry["form"]["driver"] = 99
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=r"cable_coupling\.driver: 99; allowed: \[1, 2, 3"):
        load_model(tmp_path / "model.yaml", Arm.load(example / "arm.yaml"))


def test_an_effect_sits_at_all_of_its_joints(example: Path) -> None:
    load_file(EXAMPLE)
    arm = Arm.load(example / "arm.yaml")
    model = load_model(example / "diagnosis" / "model.yaml", arm)
    (term,) = (e for e in model.effects if e.name == "cable_coupling")
    assert term.joints == (5, 2)
    assert term.placement == {"joint": 5, "driver": 2}


# ------------------------------------------------------------------ a package


Longarm = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def longarm(capsys: pytest.CaptureFixture[str]) -> Longarm:
    """The program, in an environment with the packages of a folder too, or without."""

    def call(site: Path | None, *words: object) -> subprocess.CompletedProcess[str]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(catalogue, "_others", {})
            if site is not None:
                patch.syspath_prepend(site)
            catalogue._load_entry_points.cache_clear()
            try:
                code = run([str(word) for word in words])
            finally:
                catalogue._load_entry_points.cache_clear()
                sys.modules.pop("cable_effects", None)
        return subprocess.CompletedProcess(words, code, *capsys.readouterr())

    return call


def test_an_installed_package_brings_its_effect(
    example: Path, tmp_path: Path, longarm: Longarm
) -> None:
    site = left_by_pip(tmp_path, "cable_coupling", "cable_effects:CableCoupling")
    listed = json.loads(longarm(site, "effects", "--json").stdout)
    assert listed[-1]["effect"] == "cable_coupling"
    assert listed[-1]["from"] == "package cable-effects 1.2, entry point cable_coupling"
    words = ("calibrate", example / "arm.yaml", example / "samples.csv")
    made = longarm(site, *words, "--effect", "cable_coupling", "-o", tmp_path / "model.yaml")
    assert made.returncode == 0, made.stderr
    judged = ("evaluate", example / "arm.yaml", "--test", example / "test.csv")
    assert longarm(site, *judged, "--model", tmp_path / "model.yaml").returncode == 0
    alone = longarm(None, *judged, "--model", tmp_path / "model.yaml")
    assert alone.returncode == 2
    assert "package cable-effects 1.2, entry point cable_coupling" in alone.stderr


@pytest.mark.parametrize(
    ("entry", "target", "said"),
    [
        ("cable_coupling", "cable_effects:Nothing", "cable_effects:Nothing that can be loaded"),
        ("cable_coupling", "no_such_module:Cable", "no_such_module"),
        ("other_name", "cable_effects:CableCoupling", "the effect's own, cable_coupling"),
        ("cable_coupling", "cable_effects:JointTerm", "nothing abstract"),
    ],
)
def test_a_broken_entry_point_is_one_line(
    tmp_path: Path, entry: str, target: str, said: str, longarm: Longarm
) -> None:
    failed = longarm(left_by_pip(tmp_path, entry, target), "effects")
    assert failed.returncode == 2
    assert failed.stderr.startswith(f"longarm: package cable-effects 1.2, entry point {entry}: ")
    assert said in failed.stderr
    assert len(failed.stderr.splitlines()) == 1


def left_by_pip(site: Path, entry: str, target: str) -> Path:
    """An installed package with an entry point, as pip leaves it."""
    record = site / "cable_effects-1.2.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: cable-effects\nVersion: 1.2\n")
    (record / "entry_points.txt").write_text(f"[longarm_comp.effects]\n{entry} = {target}\n")
    (site / "cable_effects.py").write_text(EXAMPLE.read_text())
    return site


def test_a_broken_entry_point_hurts_no_other_model(
    example: Path, tmp_path: Path, longarm: Longarm
) -> None:
    arm = Arm.load(example / "arm.yaml")
    save_model(tmp_path / "model.yaml", store(Model(arm, (JointGain(2, gain=0.01),))))
    words = ("evaluate", example / "arm.yaml", "--test", example / "test.csv")
    site = left_by_pip(tmp_path, "cable_coupling", "no_such_module:Cable")
    assert longarm(site, *words, "--model", tmp_path / "model.yaml").returncode == 0


# ------------------------------------------------------------------ a file


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("def", "SyntaxError"),
        ("x = 1", "a class with a name, of Effect or Bias"),
        (EXAMPLE.read_text().replace('"cable_coupling"', '"joint_gain"'), "longarm_comp does not"),
    ],
)
def test_a_file_that_is_none_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(InputError, match=r"mine\.py") as caught:
        load_file(path)
    assert said in str(caught.value)
    assert set(catalogue.registered()) == set(BUILT_IN)


def test_a_missing_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["effects", "--effects", str(tmp_path / "none.py")]) == 2
    assert "none.py: effects: 'missing'" in capsys.readouterr().err


def test_a_file_is_executed_once_and_anew_when_it_changed(tmp_path: Path) -> None:
    path, log = tmp_path / "mine.py", tmp_path / "log"
    path.write_text(EXAMPLE.read_text() + f"\nopen({str(log)!r}, 'a').write('x')\n")
    (first,), (again,) = load_file(path), load_file(path)
    assert first is again
    assert log.read_text() == "x"
    path.write_text(path.read_text().replace("prior=0.02", "prior=0.5"))
    (changed,) = load_file(path)
    assert changed.declared()[0].prior == 0.5
    assert catalogue.registered()["cable_coupling"] is changed


def test_two_files_may_not_share_a_name(tmp_path: Path) -> None:
    (tmp_path / "custom_effect.py").write_text(EXAMPLE.read_text())
    load_file(EXAMPLE)
    with pytest.raises(InputError, match=r"a name that file custom_effect\.py does not have"):
        load_file(tmp_path / "custom_effect.py")
