"""Rows that a fit sets aside are part of the verdict, and a poor start loses no good row."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from few_effects import few_effects
from palletiser import PALLETISER, one_at_a_time, rows, truth
from small_arm import ARM as SMALL
from small_arm import measured

import longarm_comp as la
from longarm_comp.core.arm.context import ORDER
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.moved_parts import refuse_moved_parts
from longarm_comp.core.calibration.plausible import refuse_implausible
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import write_csv


@pytest.fixture(scope="module")
def made() -> Model:
    return truth(np.random.default_rng(4))


@pytest.mark.parametrize("seed", [4, 8])
def test_no_good_row_is_lost_to_a_poor_start(seed: int) -> None:
    """Of the second arm twelve were, where the fit began with the rows that were near its start."""
    made = truth(np.random.default_rng(seed))
    fresh = rows(np.random.default_rng(1).uniform(-0.5, 0.3, (40, 6)), made, seed=2)
    *_, (_, fitted) = fit_stages(Model(PALLETISER), one_at_a_time(made)[0])
    assert not len(fitted.outliers)
    left = np.linalg.norm(fresh.xyz - fitted.model.measured(fresh.q, fresh.context()), axis=1)
    assert left.mean() < 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_every_seed_writes_the_same(made: Model, seed: int) -> None:
    found = la.calibrate(PALLETISER, one_at_a_time(made)[0], seed=seed)
    assert found.set_aside == SetAside((), 0.0, ())
    assert found.held_out.rows[-1]["set_aside"] == 0


def test_a_coupling_is_named_before_anything_is_believed(made: Model) -> None:
    fall = r"q3 looks coupled with q2: the joint is q3 \+ q2: \d+ -> [\d.]+ mm"
    for session in (one_at_a_time(made)[1], one_at_a_time(made)[1].take(np.arange(0, 108, 2))):
        with pytest.raises(InputError, match=fall):
            la.calibrate(PALLETISER, session)


def test_two_mistakes_at_once_are_named(made: Model) -> None:
    """Where the last joint's sign is another's half turn as well, either may be named."""
    session = rows(np.random.default_rng(7).uniform(-0.9, 0.9, (60, 6)), made)
    q = session.q.copy()
    q[:, [0, 5]] *= -1.0
    with pytest.raises(
        InputError, match=r"q1 looks negated and q[56] looks [^:]*: \d+ -> 3\.\d+ mm"
    ):
        la.calibrate(PALLETISER, dataclasses.replace(session, q=q))


def test_rows_set_aside_that_share_a_joint_are_a_cause(made: Model) -> None:
    """A coupling of two joints spoils the rows in which the second one moves, and only these."""
    *_, (_, fitted) = fit_stages(Model(PALLETISER), one_at_a_time(made)[1])
    found = SetAside.of(fitted.session, fitted.weights == 0)
    assert found.share > 0.1
    assert found.shared_by[0].input == "q2" and found.shared_by[0].value == "other than 0"
    assert found.shared_by[0].rows == len(found.rows) == 18
    assert found.shared_by[0].p_value < 1e-4
    first = {"input": "q2", "value": "other than 0", "rows": 18}
    assert found.record["rows"] == 18 and found.record["shared_by"][0].items() >= first.items()
    for of_fit in (np.zeros((20, 3)), None):  # of a calibration; a diagnosis advises no other one
        with pytest.raises(JobError, match="correct arm") as refused:
            refuse_implausible(fitted, of_fit, np.zeros((20, 3)), {})
        assert ("longarm diagnose" in str(refused.value)) == (of_fit is not None)


def spoilt(n: int, bad: np.ndarray, **more: np.ndarray) -> SetAside:
    q = np.random.default_rng(3).uniform(-1, 1, (n, 3))
    labels = {"marker": np.array(["a", "b"])[np.arange(n) % 2]}
    session = Session.record(q, q, labels=labels, columns=more)
    return SetAside.of(session, np.isin(np.arange(n), bad))


def test_gross_errors_share_nothing() -> None:
    suspected = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        found = spoilt(120, rng.choice(120, 8, replace=False), warmth=np.arange(120.0))
        suspected += bool(found.shared_by)
    assert suspected <= 2


@pytest.mark.parametrize(
    ("bad", "shared"),
    [
        (np.arange(70, 78), "order"),
        (np.r_[np.arange(70, 77), 20], "order"),  # and one that came alone
        (np.arange(0, 60, 4) * 2, "marker"),
    ],
)
def test_what_rows_share_is_named(bad: np.ndarray, shared: str) -> None:
    found = spoilt(120, bad, **{ORDER: np.arange(120.0)})  # as a diagnosis numbers them
    assert [s.input for s in found.shared_by] == [shared]
    assert found.shared_by[0].p_value < 1e-3


@pytest.mark.parametrize(("side", "said"), [(0, "unknown"), (1, "+1"), (-1, "-1")])
def test_the_side_that_rows_share_is_the_one_they_have(side: int, said: str) -> None:
    """Where no row told its side, all had arrived from below."""
    rng = np.random.default_rng(2)
    sides = rng.choice([s for s in (-1, 0, 1) if s != side], (80, SMALL.n))
    bad = np.zeros(80, bool)
    bad[rng.permutation(80)[:12]] = True
    sides[bad, 1] = side
    rows = dataclasses.replace(measured(80, rng), approach=sides)
    shared = SetAside.of(rows, bad).shared_by
    assert [(s.input, s.value) for s in shared] == [("approach of q2", said)]


def test_a_region_is_shared() -> None:
    n = 120
    warmth = np.random.default_rng(5).uniform(10, 30, n)
    found = spoilt(n, np.flatnonzero(warmth > 28.5), warmth=warmth)
    assert [s.input for s in found.shared_by] == ["warmth"]
    low, high = map(float, found.shared_by[0].value.split(" to "))
    assert 28.4 < low < high < 30.1


# ------------------------------------------------------------------ rows in two groups


def anywhere(made: Model, n: int = 60) -> Session:
    return rows(np.random.default_rng(7).uniform(-0.6, 0.6, (n, 6)), made, seed=8)


@pytest.mark.parametrize(
    ("first", "end", "when"), [(18, 41, "18 to 40"), (0, 21, "21 on"), (39, 60, "39 on")]
)
def test_rows_of_a_base_that_stood_elsewhere_for_a_while_are_told(
    made: Model, first: int, end: int, when: str
) -> None:
    session = anywhere(made)
    there = (session.index >= first) & (session.index < end)
    away = dataclasses.replace(session, xyz=session.xyz + there[:, None] * [0.0, 0.012, 0.016])
    *_, (_, fitted) = fit_stages(Model(PALLETISER), away)
    with pytest.raises(JobError, match=rf"from index {when} the base looks moved \(.* -> 0\.\d+ "):
        refuse_moved_parts(fitted)


def test_a_base_that_was_moved_is_told_with_its_row(made: Model) -> None:
    session = anywhere(made)
    late = session.index >= 24
    away = dataclasses.replace(session, xyz=session.xyz + late[:, None] * [0.02, 0.0, 0.0])
    *_, (_, fitted) = fit_stages(Model(PALLETISER), away)
    with pytest.raises(
        JobError, match=r"from index 24 on the base looks moved \(9\.\d+ -> 0\.\d+ "
    ):
        refuse_moved_parts(fitted)
    far = dataclasses.replace(session, xyz=session.xyz + late[:, None] * [0.2, 0.0, 0.0])
    with pytest.raises(InputError, match="row 73 on looks measured from another base"):
        la.calibrate(PALLETISER, far)
    told = dataclasses.replace(away, labels={**away.labels, "group": np.where(late, "b", "a")})
    assert la.calibrate(PALLETISER, told).held_out.rows[-1]["mean_mm"] < 0.1


def test_a_reflector_that_was_moved_is_told_with_its_row(made: Model) -> None:
    session = anywhere(made)
    knocked = (session.index >= 33) & (session.labels["marker"] == "M2")
    axes = made.pose(session.q, session.context())[:, :3, :3]
    shift = np.einsum("nij,j->ni", axes, [0.0, 0.004, 0.003])
    away = dataclasses.replace(session, xyz=session.xyz + knocked[:, None] * shift)
    with pytest.raises(JobError, match=r"share marker M2 \(\d+ of them, p \S+\)|marker M2 looks"):
        la.calibrate(PALLETISER, away)


def test_an_arm_that_stayed_was_not_moved(made: Model) -> None:
    *_, (_, fitted) = fit_stages(Model(PALLETISER), anywhere(made))
    refuse_moved_parts(fitted)


@pytest.mark.parametrize("rows", [(40,), (40, 41)])
def test_one_or_two_gross_errors_are_no_move(made: Model, rows: tuple[int, ...]) -> None:
    """Wherever the base stood, it would meet so few rows: they must not pass for a move."""
    session = anywhere(made)
    xyz = session.xyz.copy()
    xyz[list(rows)] += [0.002, 0.0, 0.001]
    *_, (_, fitted) = fit_stages(Model(PALLETISER), dataclasses.replace(session, xyz=xyz))
    refuse_moved_parts(dataclasses.replace(fitted, weights=np.ones(len(session))))


def test_both_commands_name_the_rows_that_they_set_aside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], rng: np.random.Generator
) -> None:
    rows = measured(80, rng)
    xyz = rows.xyz.copy()
    xyz[7] += 0.2
    xyz[40] -= 0.3
    (tmp_path / "arm.yaml").write_text(SMALL.model_dump_json(exclude_defaults=True))
    write_csv(la.Session.record(rows.q, xyz, index=np.arange(100, 180)), tmp_path / "s.csv")
    shell = Shell(tmp_path, capsys)
    files = (tmp_path / "arm.yaml", tmp_path / "s.csv", "-o")
    for words in (("calibrate", *files, tmp_path / "model.yaml"),
                  ("diagnose", *files, tmp_path / "diagnosis", "--no-network")):  # fmt: skip
        with few_effects((JointGain,)):
            assert shell(*words) == 0, shell.err
        assert "2 gross outliers (2.5%), the worst 5" in shell.err
        assert "2 rows set aside (2.5%): 107, 140" in shell.err
        if words[0] == "calibrate":
            assert "Placed by all rows, in the frame of the measurements" in shell.out
    (base,) = shell.json("calibrate", *files, tmp_path / "model.yaml")["places"]
    assert base["where"] == "base" and all(0.0 < sd < 5.0 for sd in base["sd_mm"])
