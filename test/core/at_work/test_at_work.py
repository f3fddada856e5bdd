"""The recursive posterior of the model at work, on the small arm with play in one joint."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from at_work_arm import JOINT, LAG, NOISE, VARIANCE, Work, fitted, true_tip
from hidden_arm import SIGMA
from read_arm import ARM as HEAVY
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import LEGS
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.at_work import file
from longarm_comp.core.at_work.changes import Parameters
from longarm_comp.core.at_work.explanations import Branch, Explanations
from longarm_comp.core.at_work.learner import Learner, PoseRequest
from longarm_comp.core.at_work.posterior import RecursivePosterior
from longarm_comp.core.at_work.row import Row
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.posterior.found import CREDIBLE
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.drives import FrictionHysteresis as TruePlay
from longarm_comp.sim.hidden.drives import JointGain

JOINT_AXIS = np.eye(ARM.n)[JOINT - 1]


def test_the_change_of_a_loosely_known_parameter_is_the_whole_of_it() -> None:
    """What "nothing changed" made of the sightings since was taken for the value before."""
    rng = np.random.default_rng(3)
    space = Parameters.of(fitted(), Work().pose()[1])
    (own,) = space.own(space.keys.index(("joint_zero", "joint 1")))
    was, width = float(space.values(space.model)[own]), float(space.widths[own])
    loose = np.array([[(0.3 * width) ** 2]])
    known = RecursivePosterior.begin(space, space.values(space.model), np.array([own]), loose)
    explained = Explanations((Branch(1.0, known),))
    for k in range(40):
        columns = np.zeros((3, len(space)))
        columns[:, own] = 1e-3 / width * rng.standard_normal(3)
        value = was + (width if k >= 5 else 0.0)
        seen = columns[:, own] * value + 2e-4 * rng.standard_normal(3)
        explained = explained.update(Row(float(k), columns, seen, 4e-8 * np.eye(3), 1.0))
        if explained.branches[0].changes:
            break
    (change,) = explained.branches[0].changes
    before = dict(zip(space.own(space.keys.index(change.key)), change.before, strict=True))
    assert before[own] == pytest.approx(was, abs=0.05 * width)
    now = explained.branches[0].posterior.expected_values[own]
    assert now == pytest.approx(was + width, abs=0.1 * width)


def test_a_jump_at_any_time_is_what_a_whole_regression_gives() -> None:
    """Gram and right side of a jump, and how the other numbers follow it, without recursion."""
    rng = np.random.default_rng(3)
    space = Parameters.of(fitted(), Work().pose()[1])
    active = np.arange(6)
    root = rng.standard_normal((6, 6))
    prior = root @ root.T
    known = RecursivePosterior.begin(space, space.values(space.model), active, prior)
    rows = [
        Row(float(k), rng.standard_normal((3, len(space))), rng.standard_normal(3), np.eye(3), 1.0)
        for k in range(9)
    ]
    for row in rows:
        known = known.update(row)
    columns = np.concatenate([row.columns for row in rows])
    data = np.concatenate([row.value for row in rows]) - columns @ space.values(space.model)
    a = columns[:, active]
    whitened = np.linalg.inv(a @ prior @ a.T + np.eye(len(a)))
    for onset, change in ((2, 0), (5, len(space.keys) - 1)):
        places = space.own(change)
        jump = columns[:, places] * space.widths[places]
        jump[: 3 * onset] = 0.0
        k = len(places)
        np.testing.assert_allclose(
            known.gram[onset, change, :k, :k], jump.T @ whitened @ jump, rtol=1e-6
        )
        np.testing.assert_allclose(
            known.along[onset, change, :k], jump.T @ whitened @ data, rtol=1e-6
        )
        unit = np.eye(len(space))[places[0]]
        shifted = data - jump[:, 0] / space.widths[places[0]]
        expected = prior @ a.T @ whitened @ shifted
        got = (known.mean - space.values(space.model))[active] - known.response[onset] @ unit
        np.testing.assert_allclose(got, expected, atol=1e-8)


def test_what_the_model_holds_wears_as_often_as_something_new_appears() -> None:
    space = Parameters.of(fitted(), Work().pose()[1])
    chance = np.exp(space.log_prior)
    held = np.array([key in {t.key for t in fitted().terms} for key in space.keys])
    assert chance.sum() == pytest.approx(1.0)
    assert chance[held].sum() == pytest.approx(0.5)
    new: dict[str, float] = {}
    for key, p in zip(np.array([k[0] for k in space.keys])[~held], chance[~held], strict=True):
        new[key] = new.get(key, 0.0) + p
    assert np.ptp(list(new.values())) < 1e-12  # every name is as likely


def test_in_quiet_hours_nothing_is_named_and_nothing_is_lost() -> None:
    work, begun = Work(), Learner.of(fitted())
    learner = work.learned(begun, 60)
    assert learner.explanations is not None and learner.named == () and not learner.unexplained
    assert learner.doubtful == 0
    totals = [b.posterior.total for b in learner.explanations.branches]
    assert max(totals) < -np.log(0.9)  # nothing changed
    assert work.missed(learner.model, 0.0) < work.missed(begun.model, 0.0) + 2e-5
    first, last = learner.versions[0].model.uncertainty, learner.model.uncertainty
    assert first is not None and last is not None
    before, after = (np.trace(u.factor @ u.factor.T) for u in (first, last))
    assert after <= before * (1 + 1e-6)  # no drift: what is known is never forgotten


def test_play_that_grows_is_named_and_learned() -> None:
    work = Work()
    calm = work.learned(Learner.of(fitted()), 5)
    grown, seen = work.learned(calm, 1, 2e-3), 1
    while not grown.named:
        grown, seen = work.learned(grown, 1, 2e-3), seen + 1
        assert seen <= 15
    (named,) = grown.named
    assert named.where == f"joint {JOINT}" and named.since_s == pytest.approx(360.0, abs=61.0)
    assert work.missed(calm.model, 2e-3) > 4e-4
    later = work.learned(grown, 12, 2e-3)
    assert work.missed(later.model, 2e-3) < 1e-4
    (known,) = later.now  # no load tells these apart on this arm
    names = {known.effect, *(name for name, _ in known.rivals)}
    assert "friction_hysteresis" in names
    assert names <= {"friction_hysteresis", "backlash"}
    again = work.learned(later, 8, 4e-3)  # what wears, wears on
    assert len(again.named) == 1
    assert work.missed(again.model, 4e-3) < 1e-4


def test_a_step_is_bounded() -> None:
    work = Work()
    calm = dataclasses.replace(work.learned(Learner.of(fitted()), 3), step_m=1e-4)
    for _ in range(6):
        q, context, side = work.pose()
        tip = true_tip(q[None], side[None], 3e-3)[0]
        after = calm.learn(q, context, tip, VARIANCE, 0.0)
        assert np.linalg.norm(after.model.tip(q, context) - calm.model.tip(q, context)) < 1.1e-4
        calm = after


def test_a_doubtful_sighting_teaches_nothing() -> None:
    work = Work()
    calm = work.learned(Learner.of(fitted()), 5)
    fooled = work.learned(calm, 1, off=0.05)
    assert np.array_equal(fooled.model.values, calm.model.values)
    q, context, _ = work.pose()
    after = work.learned(fooled, 3)
    before, meanwhile, then = (
        expected_miss(m, q, context, m.tip(q, context)).sizes[1]
        for m in (calm.model, fooled.model, after.model)
    )
    assert meanwhile > 3 * before and then < 1.1 * before
    assert after.doubtful == 1 and after.named == ()
    assert work.missed(after.model, 0.0) < 1e-4


def test_one_wrong_sighting_that_a_slipped_joint_would_explain_is_forgotten() -> None:
    work = Work()
    calm = work.learned(Learner.of(fitted()), 5)
    q, context, side = work.pose()
    tip = true_tip(q[None] + 5e-3 * np.eye(ARM.n)[0], side[None])[0]
    fooled = calm.learn(q, context, tip, VARIANCE, 400.0)
    assert np.array_equal(fooled.model.values, calm.model.values)
    assert fooled.explanations is not None and fooled.doubtful == 0  # it explains the sighting well
    after = work.learned(fooled, 4)
    assert after.doubtful == 1 and work.missed(after.model, 0.0) < 1e-4


def test_what_a_sighting_parted_is_kept_for_ten_more() -> None:
    known = Work().learned(Learner.of(fitted()), 3).explanations
    assert known is not None
    likely = dataclasses.replace(known.branches[0], weight=1.0 - 1e-6)
    young = dataclasses.replace(likely, weight=1e-6, left_out=1, age=0)
    both, seen = Explanations((likely, young)), np.zeros((3, len(known.space)))
    for _ in range(9):
        both = both.update(Row(0.0, seen, np.zeros(3), 1e-8 * np.eye(3), 1.0))
        assert len(both.branches) == 2
    both = both.update(Row(0.0, seen, np.zeros(3), 1e-8 * np.eye(3), 1.0))
    assert len(both.branches) == 1 and both.left_out == 0


def test_what_may_have_changed_is_in_the_covariance() -> None:
    """Play has grown by 0.8 mrad with a probability of some 80 %."""
    work = Work()
    learner = work.learned(work.learned(Learner.of(fitted()), 5), 3, more=4e-4)
    assert learner.explanations is not None
    known = learner.explanations.branches[0].posterior
    chance = known.probability.sum(axis=0)
    c = known.space.keys.index(("friction_hysteresis", f"joint {JOINT}"))
    assert 0.5 < chance[c] < 0.95 and chance.argmax() == c
    (width, *_), jump = known.space.own(c), 8e-4
    (unchanged,) = np.flatnonzero(known.active == width)
    for active, covariance in (known.spread, learner.explanations.covariance):
        (at,) = np.flatnonzero(active == width)
        more = covariance[at, at] - known.covariance[unchanged, unchanged]
        assert 0.8 < more / (chance[c] * (1.0 - chance[c]) * jump**2) < 1.8


def test_what_no_effect_explains_is_handed_over() -> None:
    work = Work()
    learner = work.learned(work.learned(Learner.of(fitted()), 5), 12, noise=12.0)
    assert learner.unexplained and learner.named == ()
    later = work.learned(learner, 5, noise=12.0)
    assert np.array_equal(later.model.values, learner.model.values)
    assert np.trace(later.uncertainty.structure) > 9.0 * np.trace(later.prior.structure)


def test_frozen_undone_and_learning_again() -> None:
    work = Work()
    grown = work.learned(work.learned(Learner.of(fitted()), 4), 15, 2e-3)
    assert work.learned(grown.freeze(), 2, 2e-3).model is grown.model
    back = grown.undo()
    assert back.frozen and back.model is grown.versions[0].model and back.named == ()
    assert work.missed(back.model, 2e-3) > 4e-4
    assert work.learned(back, 3, 2e-3).model is back.model
    assert work.missed(work.learned(back.thaw(), 15, 2e-3).model, 2e-3) < 1e-4


def test_a_restart_goes_on_from_the_file(tmp_path: Path) -> None:
    work, path = Work(), tmp_path / "at_work.json"
    assert file.load(path, fitted(), "hash").sightings == 0  # there is none yet
    grown = work.learned(work.learned(Learner.of(fitted()), 4), 15, 2e-3)
    file.save(path, grown, "hash")
    back = file.load(path, fitted(), "hash")
    assert back.named == grown.named and back.sightings == grown.sightings
    assert work.missed(back.model, 2e-3) == pytest.approx(work.missed(grown.model, 2e-3), abs=2e-5)
    on = work.learned(back, 5, 2e-3)
    assert work.missed(on.model, 2e-3) < 1e-4 and on.named == grown.named
    assert file.load(path, fitted(), "another model").sightings == 0
    stored = json.loads(path.read_text())
    stored["served"]["uncertainty"] = None
    for text, wrong in (("{", "file"), (json.dumps(stored), "uncertainty: 'missing'")):
        path.write_text(text)
        with pytest.raises(InputError, match=rf"at_work\.json: {wrong}"):
            file.load(path, fitted(), "hash")


def test_a_model_that_does_not_say_how_good_it_is_cannot_learn() -> None:
    with pytest.raises(InputError, match="uncertainty"):
        Learner.of(Model(ARM))


def test_it_asks_for_the_pose_that_tells_rivals_apart() -> None:
    """Work in one corner cannot tell a gain from a gear that runs out of round: one pose can."""
    worn = TrueArm(ARM, [TruePlay(LAG * JOINT_AXIS), JointGain(0.01 * JOINT_AXIS)], steps=2)
    rng = np.random.default_rng(0)
    corner = ARM.mid + 0.15 * (ARM.upper - ARM.lower)

    def after(learner: Learner, q: np.ndarray, side: np.ndarray, way: np.ndarray) -> Learner:
        legs = np.zeros((ARM.n, LEGS))
        legs[:, 0] = side * way
        came = Context(approach=tuple(side), legs=tuple(legs.ravel()))
        tip = worn.tip(q[None], TrueContext(approach=side[None]))[0]
        tip = tip + NOISE * rng.standard_normal(3)
        return learner.learn(q, came, tip, VARIANCE, 60.0)

    learner = Work().learned(Learner.of(fitted()), 5)
    wanted, moves = None, 0
    while wanted is None:
        q = corner + 0.05 * (rng.random(ARM.n) - 0.5) * (ARM.upper - ARM.lower)
        learner = after(learner, q, rng.choice([-1.0, 1.0], ARM.n), np.ones(ARM.n))
        wanted, moves = learner.request_pose(Work().pose()[1]), moves + 1
        assert moves <= 10
    assert "joint_gain" in wanted.between and all(n.probability < CREDIBLE for n in learner.now)
    assert np.abs(wanted.q - corner).max() > 0.5  # far from where it works
    assert (ARM.lower <= wanted.q).all() and (wanted.q <= ARM.upper).all()
    learner = after(learner, wanted.q, wanted.side, run_up_lengths(ARM))
    (named,) = learner.now
    assert (named.effect, named.where) == ("joint_gain", f"joint {JOINT}")
    assert named.probability > CREDIBLE
    assert learner.request_pose(Work().pose()[1]) is None
    assert learner.freeze().request_pose(Work().pose()[1]) is None


def test_it_does_not_ask_where_no_pose_tells() -> None:
    """Play, friction and droop of a joint that carries no load move the tip alike everywhere."""
    work = Work()
    learner = work.learned(work.learned(Learner.of(fitted()), 5), 3, LAG)
    known = learner.explanations
    assert known is not None
    names = [b.changes[0].key[0] for b in known.branches]
    alike = {"friction_hysteresis", "backlash"}
    few = [b for b, name in zip(known.branches, names, strict=True) if name in alike]
    assert len(few) >= 2
    even = tuple(dataclasses.replace(b, weight=1.0 / len(few)) for b in few)
    unsure = dataclasses.replace(learner, explanations=dataclasses.replace(known, branches=even))
    assert unsure.request_pose(work.pose()[1]) is None


def test_it_compares_explanations_within_the_bounds_of_their_parameters() -> None:
    """A filter may expect a compliance below 0 and the tip 5 mm off: within bounds it is at 0."""
    work = Work()
    learner = work.learned(work.learned(Learner.of(fitted()), 5), 3, LAG)
    assert learner.explanations is not None
    first = learner.explanations.branches[0]
    space = learner.explanations.space
    off, soft = own = np.array(
        [
            next(k for k, s in enumerate(space.slots) if (s.owner.name, s.parameter.name) == name)
            for name in (("tip_offset", "x"), ("joint_compliance", "compliance"))
        ]
    )
    assert off < soft and space.bounds[0][soft] == 0.0
    sd = np.array([5e-3, space.widths[soft]])
    covariance = np.outer(sd, sd) * np.array([[1.01, -1.0], [-1.0, 1.0]])

    def asked(tip: float, compliance: float) -> PoseRequest | None:
        mean = space.values(fitted())
        mean[own] = sd * (tip, compliance)
        each = [
            dataclasses.replace(
                first,
                weight=0.5,
                posterior=RecursivePosterior.begin(space, at, own, covariance),
                changes=changes,
            )
            for at, changes in ((space.values(fitted()), ()), (mean, first.changes))
        ]
        return dataclasses.replace(learner, explanations=Explanations(tuple(each))).request_pose(
            work.pose()[1]
        )

    assert asked(1.0, -1.0) is None
    assert asked(1.0, 0.0) is not None


def test_right_sightings_leave_a_calibrated_model_as_good_as_it_was() -> None:
    """Parts that yield were not fitted, and the arm has none: what is learned of them is little."""
    rng = np.random.default_rng(4)
    q = HEAVY.lower + rng.random((140, HEAVY.n)) * (HEAVY.upper - HEAVY.lower)
    tips = TrueArm(HEAVY).tip(q)
    seen = tips + SIGMA * rng.standard_normal(tips.shape)
    *_, (_, fit) = fit_stages(declared_model(HEAVY), Session.record(q[:80], seen[:80]))
    model = with_uncertainty(fit)
    assert model.uncertainty is not None and model.uncertainty.absent
    learner, missed = Learner.of(model), []
    for rows in ((), range(80, 110)):
        for k in rows:
            learner = learner.learn(q[k], Context(), seen[k], np.full(3, SIGMA**2), 60.0 * k)
        off = learner.model.measured(q[110:], Context()) - tips[110:]
        missed.append(np.linalg.norm(off, axis=1).mean())
    assert missed[1] < 1.5 * missed[0] < 3e-4
