"""What the model at work promises of an arm whose parts yield, and whose fit does not hold them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hidden_arm import SIGMA
from known_arm import FRESH, NOISE, RIGID, WORK, ZEROS, calibrated, judged
from read_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.at_work import file
from longarm_comp.core.at_work.explanations import Explanations
from longarm_comp.core.at_work.learner import Learner
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.model.model import slots_of
from longarm_comp.core.model.model_file import restore, store
from longarm_comp.core.model.uncertainty import ModelUncertainty
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import JointGain
from longarm_comp.sim.hidden.geometry import JointZero
from longarm_comp.sim.hidden.loads import JointCompliance

SOFT = TrueArm(ARM, [ZEROS, JointCompliance(np.array([0.0, 4e-3, 2e-3, 0.0]))])


def learned(learner: Learner, truth: TrueArm, first: int, last: int) -> Learner:
    """Learn from some of the sightings."""
    for k in range(first, last):
        tip = truth.tip(WORK[k][None])[0] + NOISE[k]
        learner = learner.learn(WORK[k], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
    return learner


@pytest.mark.parametrize("rows", ["line", pytest.param("box", marks=pytest.mark.long), "wide"])
@pytest.mark.parametrize("truth", [SOFT, RIGID], ids=["soft", "rigid"])
def test_the_promise_holds_after_any_number_of_sightings(truth: TrueArm, rows: str) -> None:
    learner = Learner.of(calibrated(truth, rows))
    before, done, boxed = judged(learner.model, truth)[1], 0, rows == "box"
    for count in (1, 5, 20, 40):
        learner, done = learned(learner, truth, done, count), count
        inside, error, _ = judged(learner.model, truth)
        assert inside >= 0.85
        assert error < before + (0.4 if boxed else 0.2) * SIGMA
    _, error, radius = judged(learner.model, truth)
    # The arm is learned, and has not changed. Beyond a box a misfit of 10 mm is promised, so that
    # sightings there tell little of the parameters; all over, a misfit stays in the structure
    assert error < (2.5 if boxed else 1.1) * SIGMA and learner.named == ()
    assert rows != "line" or radius < 3.0 * SIGMA


def test_compliances_that_are_not_held_stay_in_the_record() -> None:
    given = calibrated(SOFT, "line")
    begun, model = given.uncertainty, learned(Learner.of(given), SOFT, 0, 12).model
    record = model.uncertainty
    assert begun is not None and record is not None
    held = {term.key for term in model.terms}
    assert {t.key for t in begun.absent} == {t.key for t in record.absent} | (
        held - {term.key for term in given.terms}
    )
    assert held.isdisjoint(t.key for t in record.absent)
    assert set(begun.slots) <= set(record.slots)
    assert 0.5 < sizes_of_compliances(record) / sizes_of_compliances(begun) < 0.95


def sizes_of_compliances(record: ModelUncertainty) -> float:
    """Standard deviations of all compliances of the calibrated record, in their priors', rms."""
    known = calibrated(SOFT, "line").uncertainty
    assert known is not None
    slots = slots_of(ARM, known.absent)
    sd = [np.linalg.norm(record.factor[record.row[s.identity]]) / s.parameter.prior for s in slots]
    return float(np.sqrt(np.mean(np.square(sd))))


def test_a_learned_model_is_stored_with_its_promise() -> None:
    model = learned(Learner.of(calibrated(SOFT, "line")), SOFT, 0, 5).model
    assert model.uncertainty is not None and model.uncertainty.absent
    back = restore(store(model), ARM, "model.yaml")
    assert judged(back, SOFT) == pytest.approx(judged(model, SOFT), rel=1e-3)
    assert judged(learned(Learner.of(back), SOFT, 5, 40).model, SOFT)[0] >= 0.85


def test_a_bounded_step_promises_what_it_left_undone() -> None:
    learner = dataclasses.replace(Learner.of(calibrated(SOFT, "line")), step_m=2e-4)
    learner = learned(learner, SOFT, 0, 5)
    inside, error, _ = judged(learner.model, SOFT)
    assert error > 5e-3 and inside >= 0.85


def test_no_step_goes_farther_than_the_given_model_promised_there() -> None:
    """A joint that slips moves the tip little where its sightings are, and far elsewhere."""
    given = calibrated(RIGID, "wide")
    learner = learned(Learner.of(given), RIGID, 0, 5)
    slipped = TrueArm(ARM, [ZEROS, JointGain(np.array([0.05, 0.0, 0.0, 0.0]))])
    fresh = FRESH[:80]
    truth = slipped.tip(fresh)
    for k in range(5, 40):
        before = learner.model
        q = WORK[k] * [0.1, 1.0, 1.0, 1.0]
        tip = slipped.tip(q[None])[0] + NOISE[k]
        learner = learner.learn(q, Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
        now = before.tip(fresh, Context())
        moved = np.linalg.norm(learner.model.tip(fresh, Context()) - now, axis=1)
        promised = expected_miss(given, fresh, Context(), now).sizes[1]
        assert (moved < 1.3 * np.maximum(learner.step_m, promised)).all()
    off = np.linalg.norm(learner.model.tip(fresh, Context()) - truth, axis=1)
    assert off.max() < 0.2 * np.linalg.norm(given.tip(fresh) - truth, axis=1).max()


@pytest.mark.parametrize(
    ("effect", "joint"),
    [
        ("joint_zero", 2),
        ("joint_gain", 1),
        pytest.param("joint_zero", 1, marks=pytest.mark.long),
        pytest.param("joint_gain", 2, marks=pytest.mark.long),
    ],
)
def test_a_change_is_named_and_the_promise_holds_from_its_third_sighting(
    effect: str, joint: int
) -> None:
    """The one changes what the model holds, the other is new to it."""
    own = np.eye(ARM.n)[joint - 1]
    size = {"joint_zero": 3e-3, "joint_gain": 0.01}[effect]
    changed = {
        "joint_zero": TrueArm(ARM, [JointZero(ZEROS.offset + size * own)]),
        "joint_gain": TrueArm(ARM, [ZEROS, JointGain(size * own)]),
    }[effect]
    learner = learned(Learner.of(calibrated(RIGID, "wide")), RIGID, 0, 5)
    learner = learned(learner, changed, 5, 6)
    may_have_changed = {identity[0] for identity in learner.uncertainty.slots}
    assert effect in may_have_changed
    learner = learned(learner, changed, 6, 7)
    for k in range(7, 20):
        learner = learned(learner, changed, k, k + 1)
        assert judged(learner.model, changed)[0] >= 0.85
    assert judged(learner.model, changed)[1] < SIGMA
    (named,) = learner.now
    assert (named.effect, named.where) == (effect, f"joint {joint}")
    assert named.by[0][2] == pytest.approx(size, rel=0.17)


@pytest.mark.parametrize("what", ["base", "tip"])
def test_where_a_knock_of_what_measures_looks_alike_the_model_stays_and_promises_both(
    what: str, tmp_path: Path
) -> None:
    learner = learned(Learner.of(calibrated(RIGID, "wide")), RIGID, 0, 5)
    given, off = learner.model, np.array([4e-3, -2e-3, 3e-3])

    def moved(q: np.ndarray) -> np.ndarray:
        turn = RIGID.pose(q)[:, :3, :3] if what == "tip" else np.eye(3)
        return RIGID.tip(q) + turn @ off

    for k in range(5, 25):
        tip = moved(WORK[k][None])[0] + NOISE[k]
        learner = learner.learn(WORK[k], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
        shift = np.linalg.norm(learner.model.tip(FRESH) - given.tip(FRESH), axis=1)
        assert shift.max() < 0.3 * np.linalg.norm(off)  # before it was sure
        if k == 5:  # it may also be wrong; taken for right, it is a knock before it has a name
            assert learner.explanations is not None
            taken = max(learner.explanations.branches, key=lambda b: b.posterior.probability.sum())
            alone = Explanations((dataclasses.replace(taken, weight=1.0),))
            nowhere = np.zeros((3, len(alone.space)))
            assert taken.changes == () and alone.chance_of_knock(nowhere, 1e-3) > 0.5
    assert learner.knocked and [n.where for n in learner.now] == [what]
    predicted = learner.model.tip(FRESH)
    radius = expected_miss(learner.model, FRESH, Context(), predicted).sizes[1]
    for truth in (RIGID.tip(FRESH), moved(FRESH)):
        assert (np.linalg.norm(predicted - truth, axis=1) <= radius).mean() >= 0.85
    file.save(tmp_path / "at_work.json", learner, "hash")
    restarted = file.load(tmp_path / "at_work.json", calibrated(RIGID, "wide"), "hash")
    for back in (restarted, learner.freeze().thaw()):  # it is seen again, and followed no more
        for k in range(25, 35):
            tip = moved(WORK[k][None])[0] + NOISE[k]
            back = back.learn(WORK[k], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
        shift = np.linalg.norm(back.model.tip(FRESH) - given.tip(FRESH), axis=1)
        assert back.knocked and shift.max() < 0.3 * np.linalg.norm(off)
    undone = learner.undo()
    file.save(tmp_path / "at_work.json", undone, "hash")
    kept = file.load(tmp_path / "at_work.json", calibrated(RIGID, "wide"), "hash")
    assert np.array_equal(kept.model.values, undone.model.values) and not undone.knocked
    for k in range(25, 35):  # set back
        tip = RIGID.tip(WORK[k][None])[0] + NOISE[k]
        learner = learner.learn(WORK[k], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
    inside, error, radius = judged(learner.model, RIGID)
    assert not learner.knocked and inside >= 0.85 and error < SIGMA and radius < 4.0 * SIGMA


def test_wrong_sightings_among_right_ones_move_nothing() -> None:
    """Each sixth shows a marker 20 mm aside; the first two of them follow each other."""
    learner = Learner.of(calibrated(RIGID, "wide"))
    wrong = {5, 6, *range(12, 38, 6)}
    for k in range(38):
        tip = RIGID.tip(WORK[k][None])[0] + NOISE[k] + [0.0, 0.02 * (k in wrong), 0.0]
        learner = learner.learn(WORK[k], Context(), tip, np.full(3, SIGMA**2), 60.0 * k)
        if k < 10 or k % 3 == 0 or k - 1 in wrong:
            inside, error, _ = judged(learner.model, RIGID)
            assert inside >= 0.85 or k == 6
            assert error < SIGMA or k == 6
    assert learner.named == () and learner.doubtful == len(wrong)
    assert learner.disagreeing == len(wrong & set(range(18, 38)))
