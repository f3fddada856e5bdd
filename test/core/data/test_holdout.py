"""The proof: every row is held out once, and what fails there is not written."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hidden_arm import at, session
from small_arm import ARM

from longarm_comp.core.data.holdout import draw_row_counts, folds_of, mark_copies, split_in_half
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.identify import diagnose as core
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.gains import Gain
from longarm_comp.core.identify.posterior.explain import _explain_halves
from longarm_comp.core.identify.posterior.explained import ExplainedSession
from longarm_comp.core.identify.posterior.found import FoundEffect
from longarm_comp.core.identify.posterior.search import ExplanationSearch
from longarm_comp.core.identify.proof import describe_worsening
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden import drives
from longarm_comp.workflows.diagnose import diagnose

GAIN = (drives.JointGain(at(2, 0.02)),)


def diagnosed(rows: Session, held: Session | None = None) -> Diagnosis:
    return core.diagnose(ARM, rows, test=held, kinds=(JointGain,))


# ------------------------------------------------------------------ rows that are fitted too


def test_a_row_to_hold_out_that_is_fitted_is_marked() -> None:
    rows = session(GAIN, n=30)
    readings = {"distance": rows.xyz[:, :1]}
    far = dataclasses.replace(
        rows, xyz=np.full((30, 3), np.nan), readings=readings, blocks=(),
        labels={"anchor": np.full(30, "a")},
    )  # fmt: skip
    also = dataclasses.replace(rows, index=rows.index + 7, readings=readings, labels=far.labels)
    assert mark_copies(also, rows).all()  # whatever else was measured beside
    assert mark_copies(rows, rows.take(slice(3, 9))).nonzero()[0].tolist() == list(range(3, 9))
    for of, other in (
        (rows, dataclasses.replace(rows, xyz=rows.xyz + 1e-9)),
        (rows, dataclasses.replace(rows, q=rows.q + 1e-9)),
        (rows, dataclasses.replace(rows, labels={"marker": np.full(30, "a")})),
        (far, dataclasses.replace(far, readings={"distance": far.readings["distance"] + 1e-9})),
        (far, dataclasses.replace(far, labels={"anchor": np.full(30, "b")})),
    ):
        assert not mark_copies(other, of).any()
        assert mark_copies(other, other).all()


def test_rows_that_are_fitted_prove_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, test, said = session(GAIN, n=30), session(GAIN, n=12, seed=5), list[str]()
    with pytest.raises(InputError, match=r"all 30 are rows of.*rows that are not fitted"):
        diagnose(ARM, rows, test=rows, note=said.append)
    both = test.followed_by(rows.take(slice(4)))
    proved = []

    def stop(arm: Any, fitted: Session, *, test: Session, **rest: Any) -> None:
        proved.append(test.xyz)
        raise JobError("stopped")

    monkeypatch.setattr(core, "diagnose", stop)
    for held in (both, test):
        with pytest.raises(JobError, match="stopped"):
            diagnose(ARM, rows, test=held, note=said.append)
    assert [len(each) for each in proved] == [12, 12]
    np.testing.assert_array_equal(proved[0], test.xyz)
    assert [line for line in said if "left out" in line] == [
        f"{both.source}: 4 of 16 rows left out: they are fitted"
    ]


# ------------------------------------------------------------------ folds


@pytest.mark.parametrize(("poses", "folds"), [(120, 5), (60, 10), (3, 3)])
def test_every_row_is_held_out_once_and_every_pose_with_all_its_visits(
    poses: int, folds: int
) -> None:
    rng = np.random.default_rng(poses)
    q = np.concatenate([once := rng.random((poses, 4)), once[:2]])
    rows = Session.record(q, np.zeros((len(q), 3)))
    fold = folds_of(rows, 3)
    assert set(fold) == set(range(folds))
    assert fold[0] == fold[-2] and fold[1] == fold[-1]
    assert np.array_equal(fold, folds_of(rows, 3))
    assert not np.array_equal(fold, folds_of(rows, 4))


def test_a_marker_that_one_fold_alone_sees_is_in_every_fit() -> None:
    rows = session(n=120)
    marker = np.where(np.arange(120) < 3, "loose", "flange")
    fold = folds_of(dataclasses.replace(rows, labels={"marker": marker}))
    assert (fold[:3] == -1).all() and (fold[3:] >= 0).all()


def test_samples_draw_whole_blocks_again() -> None:
    counts = draw_row_counts(session(n=100), 6, 2)
    assert counts.shape == (6, 100)
    assert (counts.sum(axis=1) == 100).all()
    assert (counts[:, 0:4] == counts[:, :1]).all(), "25 blocks of four poses"
    assert len({tuple(row) for row in counts.tolist()}) == 6


def test_halves_are_of_poses_with_all_their_visits_and_hold_every_row_once() -> None:
    rng = np.random.default_rng(1)
    q = np.concatenate([once := rng.random((50, 4)), once[:10]])
    first, second = split_in_half(Session.record(q, np.zeros((60, 3))), 3)
    assert (first ^ second).all() and 20 < first.sum() < 40
    assert np.array_equal(first[:10], first[50:])


def test_what_explains_half_of_the_rows_is_tried_on_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that stopped at a function of no use goes on from there; a good one stays."""
    rows = session([drives.JointGain(at(2, 0.02))])
    useless = Discovered("joint 1", "turn z", "linear(q3)", "q3 -1.0..1.0")
    search = ExplanationSearch(Model(ARM), rows, [], None, (), lambda _: None, nameless=True)
    first = search.fit_geometry()
    poor = search.fit_with(first, (FoundEffect.of((useless,), 1.0, 0.0),))
    assert poor is not None
    rows_of, explain = [], ExplanationSearch.repeat_until_best

    def spied(self: ExplanationSearch, *how: Any, **further: Any) -> ExplainedSession:
        rows_of.append(len(self.session))
        return explain(self, *how, **further)

    monkeypatch.setattr(ExplanationSearch, "repeat_until_best", spied)
    found, of_halves = _explain_halves(search, poor, 0)
    assert len(of_halves) == 2
    assert rows_of == [60, 120, 60, 120]  # either half, and all rows from what it brings
    assert [t.function for f in found.found for t in f.terms] == ["linear(q2)"]  # type: ignore[union-attr]
    assert _explain_halves(search, found, 0)[0] is found
    assert _explain_halves(search, first, 0)[0] is first  # needs no function, seeks none


def test_where_every_row_has_a_marker_of_its_own_none_can_be_held_out() -> None:
    rows = session(n=30)
    own = dataclasses.replace(rows, labels={"marker": np.arange(30).astype(str)})
    with pytest.raises(InputError, match=r"marker: 'each in few rows'; allowed: .*many poses"):
        folds_of(own)


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return diagnosed(session(GAIN))


def test_each_error_is_that_of_a_model_fitted_without_the_row(found: Diagnosis) -> None:
    held = np.concatenate([fold.rows.index for fold in found.folds])
    assert sorted(held) == list(range(120))
    for fold in found.folds:
        for fit in fold.fits.values():
            assert not set(fit.session.index) & set(fold.rows.index)
            assert len(fit.session) + len(fold.rows) == 120
        left = np.asarray(fold.rows.xyz - fold.models["with_effects"].measured(
            fold.rows.q, fold.rows.context()))  # fmt: skip
        np.testing.assert_allclose(found.proof.errors["with_effects"][fold.rows.index], left)
    assert found.verdict == "named" and not found.failed
    assert found.proof.rows["with_effects"].mean < 0.8 * found.proof.rows["calibrated"].mean
    assert found.proof.rows["with_effects"].n == 120


def test_rows_that_are_too_many_to_fit_prove_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("longarm_comp.core.identify.diagnose.MOST_ROWS", 100)
    found = diagnosed(session(GAIN, n=180))
    assert 100 <= len(found.train) < 180 and len(found.folds) == 1
    index = np.concatenate([found.train.index, found.held_out.index])
    assert sorted(index) == list(range(180))
    assert found.proof.rows["with_effects"].n == len(found.held_out)
    assert found.written == "with_effects"


# ------------------------------------------------------------------ what fails is not written


def warm(expansion: float, n: int, seed: int) -> Session:
    """The arm grows with the temperature, which goes up and down."""
    rows = session(n=n, seed=seed)
    warmth = ARM.reference_temperature_c + 2.0 * np.sin(np.arange(n))
    rows = dataclasses.replace(rows, columns={"temperature_c": warmth})
    grown = Model(ARM, (ThermalGrowth(expansion=expansion),))
    moved = grown.tip(rows.q, rows.context()) - Model(ARM).tip(rows.q)
    return dataclasses.replace(rows, xyz=rows.xyz + moved)


def test_a_model_that_fails_its_proof_is_not_written() -> None:
    """Warmth that lengthened the arm shortens it at the rows of the proof."""
    kinds = (ThermalGrowth,)
    made = core.diagnose(ARM, warm(2e-3, 120, 1), test=warm(-2e-3, 60, 9), kinds=kinds)
    fullest = list(made.fits)[-1]
    assert fullest != "calibrated"
    assert fullest in made.failed and made.written != fullest
    assert made.verdict in ("unknown", "partly")
    assert made.summary.startswith(f"The proof failed ({made.failed}): {made.written} was")
    rows = made.proof.rows
    assert rows[fullest].mean > 1.5 * rows[made.written].mean


def test_a_calibration_that_fails_its_proof_is_refused() -> None:
    """The joint that went too far goes too little there: the declared arm errs by half of it."""
    held = session((drives.JointGain(at(2, -0.02)),), n=60, seed=9)
    for model, name in ((None, "the declared arm"), (Model(ARM), "the model before")):
        with pytest.raises(
            JobError, match=rf"worse on held-out rows than {name}: mean 7\.\d+ -> 14"
        ):
            core.diagnose(ARM, session(GAIN), test=held, model=model, kinds=(JointGain,))


def test_a_few_dangerous_commands_fail_a_proof_that_the_mean_passes() -> None:
    plain = np.full(100, 1.0)
    better = np.full(100, 0.5)
    better[::20] = 5.0  # five of a hundred
    assert better.mean() < plain.mean()
    assert worsening(plain, better).endswith("at 10 worst rows")
    assert worsening(plain, np.full(100, 0.5)) == ""
    assert worsening(plain, np.full(100, 1.2)).endswith("at 100 rows")


def worsening(before: np.ndarray, after: np.ndarray, folds: int = 1) -> str:
    """What is said of errors at rows that are held out in so many folds, in 25 blocks."""
    block = np.arange(len(before)) * 25 // len(before)
    return describe_worsening(before, after, block % folds)


@pytest.mark.parametrize("rows", [1, 2, 8, 20, 60, 240])
def test_two_models_that_err_alike_seldom_fail_a_proof(rows: int) -> None:
    """However few rows there are, of which the worst tenth is fewer still."""
    rng, refused = np.random.default_rng(rows), 0
    for _ in range(200):
        shared = rng.standard_normal((rows, 3))
        one, other = (
            np.linalg.norm(shared + 0.3 * rng.standard_normal((rows, 3)), axis=1) for _ in range(2)
        )
        refused += bool(worsening(one, other))
    assert refused <= 20  # two looks, at 2.5 % each


def test_what_one_fold_missed_is_one_piece_of_evidence_however_many_rows_it_has() -> None:
    rng, refused = np.random.default_rng(0), 0
    for _ in range(200):
        plain = np.linalg.norm(rng.standard_normal((240, 3)), axis=1)
        fold = np.arange(240) * 25 // 240 % 5
        shared = 0.05 * rng.standard_normal(5)[fold]
        refused += bool(worsening(plain, np.abs(plain + shared), folds=5))
    assert refused <= 20
    plain = np.linalg.norm(rng.standard_normal((240, 3)), axis=1)
    assert worsening(plain, 1.2 * plain, folds=5).endswith("at 240 rows")


def test_chance_fails_no_proof() -> None:
    rng = np.random.default_rng(0)
    one, other = (np.abs(rng.standard_normal(200)) for _ in range(2))
    assert worsening(one, other) == worsening(other, one) == ""


def test_the_gain_of_nothing_is_zero_and_of_one_row_open() -> None:
    none = np.zeros((0, 3))
    assert Gain.of(none, none, np.zeros(0)) == Gain(0.0, 0.0, (0.0, 0.0))
    low, high = Gain.of(np.full((1, 3), 2.0), np.full((1, 3), 1.0), np.zeros(1)).ci95
    assert low < 0.0 < high
