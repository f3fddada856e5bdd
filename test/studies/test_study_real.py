"""The ladder on real arms, on the stated splits (Justin's data are not shipped)."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from few_effects import few_effects

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.errors import InputError
from longarm_comp.sessions.read import read_session
from longarm_comp.workflows.calibrate import calibrate
from studies import real
from studies.own_rigid import OwnRigid
from studies.real import command
from studies.real_sessions import JUSTIN, TRACKED, Measured, declared_arm, every_robot, justin
from studies.real_sets import halves, overlap, real_sets, simulate_sets
from studies.touch import EXAMPLE

RUNGS = [
    "frames_only", "joint_zeros", "rigid", "joint_compliance", "lateral_compliance", "diagnosed",
]  # fmt: skip


def printed_of(folder: Path, file: Path) -> dict[str, dict]:
    """What ``longarm study real --json`` prints of a folder with this file alone: by model, and
    the figures of the set."""
    at = folder / file.parent.name
    at.mkdir()
    (at / file.name).symlink_to(file)
    done = CliRunner().invoke(command, ["--data", str(folder), "--json"])
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    (whole,) = printed.pop("sets")
    (lines,) = printed.values()
    assert [line["model"] for line in lines] == RUNGS
    return {"set": whole} | {line["model"]: line for line in lines}


@pytest.fixture(scope="module")
def dlr_justin(justin_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    return printed_of(tmp_path_factory.mktemp("justin"), justin_data / JUSTIN)


@pytest.fixture(scope="module")
def wam(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    return printed_of(tmp_path_factory.mktemp("wam"), data_dir / TRACKED.format("wam"))


@pytest.fixture(scope="module")
def ur5(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    return printed_of(tmp_path_factory.mktemp("ur5"), data_dir / TRACKED.format("ur5"))


@pytest.mark.long
def test_justin(dlr_justin: dict[str, dict]) -> None:
    """Published 10.5, 5.64, 3.12 mm; both arms' 150 held-out postures each."""
    lines = dlr_justin
    assert lines["frames_only"]["n"] == 300
    assert 15 < lines["frames_only"]["mean_mm"] < 25
    assert lines["joint_zeros"]["mean_mm"] < lines["frames_only"]["mean_mm"]
    assert lines["rigid"]["mean_mm"] <= 11.0
    assert lines["joint_compliance"]["mean_mm"] <= 4.9
    assert lines["lateral_compliance"]["mean_mm"] <= 3.1
    assert lines["diagnosed"]["mean_mm"] <= 3.1
    assert "joint_compliance" in lines["diagnosed"]["effects"]


def test_of_a_sixth_of_the_rows_every_model_is_told(data_dir: Path, tmp_path: Path) -> None:
    """The command, with few effects to try; in `make long` with all rows and all effects."""
    head, *rows = (data_dir / TRACKED.format("wam")).read_text("utf-8").splitlines()
    grid = [row for row in rows if row.startswith("grid")]
    rest = [row for row in rows if not row.startswith("grid")]
    file = tmp_path / "part" / TRACKED.format("wam")
    file.parent.mkdir(parents=True)
    file.write_text("\n".join([head, *grid[::6], *rest]) + "\n", "utf-8")
    (tmp_path / "data").mkdir()
    with few_effects((Backlash, JointCompliance)):
        lines = printed_of(tmp_path / "data", file)
    assert lines["set"]["rows"] == lines["frames_only"]["n"] == 20
    assert lines["diagnosed"]["mean_mm"] == pytest.approx(lines["set"]["written_mm"])
    assert lines["rigid"]["mean_mm"] < lines["frames_only"]["mean_mm"] < 4.5
    low, high = lines["set"]["written_commanded_ci95_mm"]
    assert low <= lines["set"]["written_commanded_mm"] <= high


@pytest.mark.long
def test_wam(wam: dict[str, dict]) -> None:
    """A cable drive: the training rows ask for play, and a command is no worse for it."""
    lines = wam
    no_worse(lines["set"])
    assert lines["frames_only"]["n"] == lines["set"]["rows"] == 20
    assert lines["diagnosed"]["mean_mm"] == pytest.approx(lines["set"]["written_mm"])
    assert lines["frames_only"]["mean_mm"] < 4.1
    assert lines["rigid"]["mean_mm"] <= 3.1
    assert lines["diagnosed"]["mean_mm"] <= 2.5
    assert set(lines["diagnosed"]["effects"]) & {"backlash", "friction_hysteresis", "servo_droop"}


@pytest.mark.long
def test_ur5_is_rigid(ur5: dict[str, dict]) -> None:
    """The negative control: a tenth of a millimetre, and nothing that gives under load."""
    lines = ur5
    assert lines["rigid"]["mean_mm"] <= 0.10
    assert lines["diagnosed"]["mean_mm"] <= lines["rigid"]["mean_mm"]
    soft = {"joint_compliance", "bearing_tilt", "servo_droop", "base_compliance", "link_bending"}
    assert not soft & set(lines["diagnosed"]["effects"])


def no_worse(line: dict) -> None:
    """What is written helps a command on rows that were not fitted, and its promise holds."""
    assert line["written_commanded_mm"] <= line["calibrated_commanded_mm"]
    low, high = line["commanded_gain_ci95_mm"]
    assert low <= line["calibrated_commanded_mm"] - line["written_commanded_mm"] <= high
    low, high = line["written_commanded_ci95_mm"]
    assert low <= line["written_commanded_mm"] <= high
    assert line["inside_p90"] >= 0.8


@pytest.mark.long
@pytest.mark.parametrize("robot", ["dlr_justin", "wam", "ur5"])
def test_commands_are_never_worse_than_calibrated(
    request: pytest.FixtureRequest, robot: str
) -> None:
    no_worse(request.getfixturevalue(robot)["set"])


def test_no_stiffness_is_negative_and_the_torso_is_one(justin_data: Path) -> None:
    """Fitted compliances of both arms; what they share is one value."""
    parts = justin(justin_data)
    terms = [
        (
            *real.geometry_terms(p.arm, p.train),
            *real.JointCompliance.for_arm(p.arm),
            *real.BearingTilt.for_arm(p.arm),
        )
        for p in parts
    ]
    right, left = real._fit_rung(parts, terms, None)
    values = [
        {s.label: v for s, v in zip(f.slots, f.model.values, strict=True)} for f in (right, left)
    ]
    bounded = [
        value
        for f in (right, left)
        for s, value in zip(f.slots, f.model.values, strict=True)
        if s.owner.name in ("joint_compliance", "bearing_tilt")
    ]
    assert len(bounded) == 66
    assert min(bounded) >= 0.0 and max(bounded) > 1e-5
    torso = "joint_compliance / joint 2 / compliance"
    elbow = "joint_compliance / joint 9 / compliance"
    assert values[0][torso] == values[1][torso]
    assert values[0][elbow] != values[1][elbow]


def test_justins_rows_are_split_as_published(justin_data: Path) -> None:
    """350 postures of the permutation train both arms."""
    right, left = justin(justin_data)
    order = np.random.default_rng(0).permutation(500)
    for part in (right, left):
        assert set(part.train.index) == set(order[:350])
        assert set(part.test.index) == set(order[350:])


def test_a_folder_is_read_for_what_it_holds(data_dir: Path) -> None:
    """Grid rows train, random ones test; a set that is absent is no error."""
    held = every_robot(data_dir)
    rows = {name: (len(part.train), len(part.test)) for name, (part,) in held.items()}
    assert rows == {"wam": (216, 20), "ur5": (1000, 20)}


@pytest.mark.parametrize("name", ["justin_left", "justin_right", "wam", "ur5"])
def test_arm_files_declare_tolerances(name: str) -> None:
    """Every row says how far its geometry may be off."""
    arm = declared_arm(name)
    assert all(j.tolerance.a_m and j.tolerance.theta_deg for j in arm.joints)


def test_folder_without_the_data(tmp_path: Path) -> None:
    """One error that names what it may hold."""
    with pytest.raises(InputError, match="wam_ur5"):
        dict(real_sets(tmp_path))


@pytest.mark.long
def test_the_rigid_fit_by_scipy_agrees_with_calibration(data_dir: Path) -> None:
    """Two codes that share nothing leave the same at rows that neither saw."""
    (wam,) = every_robot(data_dir)["wam"]
    own = OwnRigid.fit(wam.arm, wam.train).left(wam.held_out).mean()
    ours = np.linalg.norm(
        compute_tip_errors(calibrate(wam.arm, wam.train).model, wam.held_out), axis=1
    ).mean()
    assert own == pytest.approx(ours, rel=0.1)


@pytest.mark.long
def test_halves_of_simulated_sessions_agree(demo_arm_path: Path) -> None:
    """What a half states is in the sets of the other."""
    counted = [halves(part) for part in simulate_sets(Arm.load(demo_arm_path), 4)]
    assert sum(stated for stated, _ in counted) > 0
    assert overlap(counted)["halves_overlap"] == 1.0


def test_overlap_counts_every_name_once() -> None:
    """Names that no half states say nothing."""
    assert overlap([(3, 2), (0, 0), (1, 1)]) == {"halves_stated": 4, "halves_overlap": 0.75}
    assert overlap([(0, 0)])["halves_overlap"] is None


def test_places_of_a_tool_are_held_out_in_turn() -> None:
    """Every touch once, never with the place that it is fitted from."""
    panda = Arm.load(EXAMPLE / "arm.yaml")
    rows = read_session(next(EXAMPLE.glob("panda_*.csv")), panda)
    splits = Measured(panda, rows, None).splits
    assert sum(len(out) for _, out in splits) == len(rows)
    for kept, out in splits:
        assert not set(kept.labels["location"]) & set(out.labels["location"])
