"""What else may be true of the rows: a command's promise holds whichever explanation is right."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from few_effects import few_effects

import longarm_comp as la
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.camera_errors import CameraScale
from longarm_comp.core.effects.compliances import ServoDroop
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.alternatives import MOST, weigh_alternatives
from longarm_comp.core.identify.posterior.found import FoundEffect, PossibleCause
from longarm_comp.core.identify.posterior.offer import UNLIKELY
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import restore, store
from longarm_comp.core.model.uncertainty import LEVEL, Alternative, ModelUncertainty, sizes
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import GearEccentricity as TrueEccentricity

ARM = Arm.parse(
    {
        "name": "wide",
        "convention": "mdh_craig",
        "tip": {"frame": 4, "position_m": [0.3, 0.02, 0.05]},
        "camera": {"position_m": [0.5, -3.0, 1.0]},
        "joints": [
            {"id": 1, "type": "revolute", "d_m": 0.1, "limits_deg": [-150, 150]},
            {"id": 2, "type": "revolute", "alpha_deg": 90, "a_m": 0.05, "limits_deg": [10, 70]},
            {"id": 3, "type": "prismatic", "alpha_deg": 90, "d_m": 0.4, "limits_m": [0, 0.1]},
            {"id": 4, "type": "revolute", "alpha_deg": -90, "a_m": 0.1, "limits_deg": [-30, 60]},
        ],
    },
    "wide arm",
)
ONCE, TWICE = GearEccentricity(1, order=1), GearEccentricity(1, order=2)
FRESH = ARM.lower + np.random.default_rng(9).random((300, 4)) * (ARM.upper - ARM.lower)


def truth(order: int) -> TrueArm:
    """The gear of the first joint runs out of round by 2 mrad, once or twice a turn."""
    turns = np.zeros((2, 4))
    turns[order - 1, 0] = 2e-3
    return TrueArm(ARM, [TrueEccentricity(turns, np.full((2, 4), 0.7))])


@cache
def at_three_positions(order: int = 2, seed: int = 1) -> Session:
    """Its first joint stood at three positions: a gear's first order looks like its second."""
    rng = np.random.default_rng(seed)
    share = rng.random((150, 4))
    share[:, 0] = rng.integers(3, size=150) / 2
    q = ARM.lower + share * (ARM.upper - ARM.lower)
    return Session.record(q, truth(order).tip(q) + 2e-4 * rng.standard_normal((150, 3)))


@cache
def fitted(form: GearEccentricity, order: int = 2, seed: int = 1) -> ModelFit:
    rows = at_three_positions(order, seed)
    *_, (_, fit) = fit_stages(declared_model(ARM), rows)
    return fit_model(fit.model.plus(form), rows, near=fit)


def found(fit: ModelFit, *rivals: tuple[Any, float], presence: float = 1.0, **more) -> FoundEffect:
    (term,) = (t for t in fit.model.terms if t.name == ONCE.name)
    own = (term, 1.0 - sum(p for _, p in rivals))
    each = (PossibleCause(Candidate(t.name, (t,)), 20.0, p) for t, p in (own, *rivals))
    return FoundEffect(tuple(each), presence, **more)


def promising(fit: ModelFit, others: tuple[Alternative, ...]) -> Model:
    model = with_uncertainty(fit)
    assert model.uncertainty is not None
    known = dataclasses.replace(model.uncertainty, alternatives=others)
    return dataclasses.replace(model, uncertainty=known)


def test_lengths_of_errors_of_which_one_is_true(rng: np.random.Generator) -> None:
    chance = np.array([0.7, 0.25, 0.05])
    means = np.array([[0.0, 0.2, 0.0], [1.5, 0.0, 1.0], [0.0, -9.0, 0.0]])
    factor = np.linalg.qr(rng.standard_normal((3, 3)))[0] * [1.0, 0.5, 0.1]
    which = rng.choice(3, 200_000, p=chance)
    drawn = np.linalg.norm(means[which] + rng.standard_normal((200_000, 3)) @ factor.T, axis=1)
    expected, within = sizes(factor @ factor.T, means, chance)
    assert expected == pytest.approx(drawn.mean(), rel=0.025)
    assert within == pytest.approx(np.quantile(drawn, LEVEL), rel=0.025)
    many = sizes(np.tile(factor @ factor.T, (4, 1, 1)), np.tile(means[:, None], (4, 1)), chance)
    np.testing.assert_allclose(many, np.tile([[expected], [within]], 4))


def test_another_form_moves_the_tip_as_its_own_fit_does() -> None:
    fit = fitted(ONCE)
    other = Candidate(TWICE.name, (TWICE,))
    (alone,) = weigh_alternatives(fit, [found(fit, otherwise=((other, 0.0),))], [])
    assert alone.chance == pytest.approx(0.5) and alone.terms == (TWICE,)
    model = promising(fit, (alone,))
    tips = model.tip(FRESH, Context())
    apart = fitted(TWICE).model.tip(FRESH, Context()) - tips
    (mine,) = expected_miss(model, FRESH, Context(), tips).apart
    assert np.abs(apart).max() > 3e-3
    np.testing.assert_allclose(mine, apart, atol=0.05 * np.abs(apart).max())
    single = expected_miss(model, FRESH[7], Context(), tips[7])
    np.testing.assert_allclose(single.apart[0], mine[7], atol=1e-9)


def test_more_places_of_an_effect_leave_it_where_it_is() -> None:
    """The rows tell as much of the first joint as before, and that the second one turns true."""
    fit = fitted(ONCE)
    more = Candidate(ONCE.name, (ONCE, GearEccentricity(2, order=1)))
    (other,) = weigh_alternatives(fit, [found(fit, otherwise=((more, 0.0),))], [])
    assert [t.where for t in other.terms] == ["joint 2"]
    own = [s for s in fit.slots if s.owner.key == ONCE.key]
    moved = other.moves_of([s.identity for s in own])[0]
    assert np.abs(moved).max() < 0.02 * max(abs(s.value) for s in own)


def test_a_promise_holds_whichever_form_is_true() -> None:
    """Where the rows show either and the other one is true, 17 % of the commands were inside."""
    inside = np.zeros((2, 2, 5))  # by truth, with and without the other form, by session
    for order, seed in np.ndindex(2, 5):
        fit = fitted(ONCE, order + 1, seed)
        told = found(fit, otherwise=((Candidate(TWICE.name, (TWICE,)), 0.0),))
        others = weigh_alternatives(fit, [told], [])
        for k, model in enumerate((promising(fit, others), promising(fit, ()))):
            tips = model.tip(FRESH, Context())
            off = np.linalg.norm(truth(order + 1).tip(FRESH) - tips, axis=1)
            radius = expected_miss(model, FRESH, Context(), tips).sizes[1]
            inside[order, k, seed] = (off <= radius).mean()
    assert inside[1, 1].mean() < 0.3 and inside[0, 1].mean() > 0.8
    assert inside[1, 0].mean() > 0.7 and 0.85 < inside[:, 0].mean() < 0.97


def test_the_covariance_is_that_about_the_tip_of_the_model() -> None:
    fit = fitted(ONCE)
    told = found(fit, otherwise=((Candidate(TWICE.name, (TWICE,)), -1.0),))
    model, alone = promising(fit, weigh_alternatives(fit, [told], [])), promising(fit, ())
    tips = model.tip(FRESH, Context())
    miss, before = (expected_miss(m, FRESH, Context(), tips) for m in (model, alone))
    apart, chance = miss.apart[0], 1.0 / (1.0 + np.e)
    more = chance * (apart[:, :, None] * apart[:, None, :] + miss.further[0])
    np.testing.assert_allclose(miss.covariance - before.covariance, more, atol=1e-12)
    assert (miss.plus(1e-6 * np.eye(3)).sizes[1] > miss.sizes[1]).all()
    q = at_three_positions().q  # where the rows stood both say the same
    there, usual = (
        expected_miss(m, q, Context(), m.tip(q, Context())).sizes[1] for m in (model, alone)
    )
    assert np.median(there / usual) < 1.1


def test_absence_rivals_and_doubtful_effects_count_by_their_probability() -> None:
    fit = fitted(ONCE)
    gain, scale = JointGain(1, gain=0.01), CameraScale()
    mine = found(fit, (gain, 0.2), (scale, 0.1), presence=0.95)
    doubt = FoundEffect.of((JointGain(2),), 0.3, 1.0)
    others = weigh_alternatives(fit, [mine], [doubt])
    of_mine = np.array([0.95 * 0.7, 0.05, 0.95 * 0.2, 0.95 * 0.1])
    every = np.outer(of_mine, [0.7, 0.3]).ravel()
    assert [a.chance for a in others] == pytest.approx(sorted(every[1:], reverse=True))
    wheres = [tuple(t.where for t in a.terms) for a in others]
    assert wheres.count(("joint 1", "joint 2")) == wheres.count(("joint 1",)) == 1
    assert wheres.count(("joint 2",)) == 3 and wheres.count(()) == 2  # the camera moves no tip
    (slot,) = (s for s in fit.slots if s.parameter.name == "cosine")
    moved = {float(a.moves_of([slot.identity])[0, 0]) for a in others}
    assert -slot.value in moved and min(map(abs, moved)) < 0.1 * abs(slot.value)
    elsewhere = mine.with_terms([JointGain(4, gain=0.1)])
    assert not weigh_alternatives(fit, [elsewhere], [])  # the model does not hold it


def test_unlikely_alternatives_are_left_out_and_the_likeliest_stand_for_many() -> None:
    fit = fitted(ONCE)
    assert not weigh_alternatives(fit, [found(fit, presence=1.0 - 0.9 * UNLIKELY)], [])
    forms = tuple(
        (Candidate(TWICE.name, (GearEccentricity(1, order=k),)), 0.0) for k in range(2, 13)
    )
    others = weigh_alternatives(fit, [found(fit, otherwise=forms)], [])
    assert len(others) == MOST
    assert sum(a.chance for a in others) == pytest.approx(11 / 12)


def test_a_named_rival_replaces_all_effects_of_its_name() -> None:
    gains = JointGain(2, gain=1e-3), JointGain(4, gain=1e-3)
    fit = fit_model(fitted(ONCE).model.plus(gains[0]), at_three_positions())
    of_gain = FoundEffect.of((next(t for t in fit.model.terms if t.key == gains[0].key),), 1.0, 9.0)
    mine = found(fit, (gains[1], 0.5))
    (other,) = weigh_alternatives(fit, [mine, of_gain], [])
    slots = [s for s in fit.slots if s.owner.key == gains[0].key]
    lost = other.moves_of([s.identity for s in slots])[0]
    np.testing.assert_allclose(lost, [-s.value for s in slots])
    assert len(slots) == 1 and other.terms == (gains[1],)


def test_an_alternative_counts_where_its_circumstances_are_known() -> None:
    grown = Alternative(0.4, (), np.zeros((1, 0)), (ThermalGrowth(),))
    model = promising(fitted(ONCE), (grown,))
    q = ARM.mid
    tip = model.tip(q, Context())
    assert not len(expected_miss(model, q, Context(), tip).chance)
    warm = Context(columns={"temperature_c": 40.0})
    assert expected_miss(model, q, warm, tip).chance.tolist() == [0.4]


def test_what_encoders_see_is_no_alternative_by_readings() -> None:
    given = ARM.model_dump(exclude_defaults=True)
    given["joints"] = [{**joint, "encoder": "motor"} for joint in given["joints"]]
    arm, droops = Arm.parse(given, "read arm"), ServoDroop(2)
    other = Alternative(0.5, (), np.zeros((1, 0)), (TWICE, droops))
    none = np.zeros((3, 3))
    known = ModelUncertainty((), np.zeros((0, 0)), none, none, 0.0, 9, alternatives=(other,))
    read = by_readings(dataclasses.replace(declared_model(arm), uncertainty=known)).uncertainty
    assert read is not None and read.alternatives[0].terms == (TWICE,)


def test_the_file_says_what_else_may_be_true() -> None:
    fit = fitted(ONCE)
    told = found(fit, presence=0.9, otherwise=((Candidate(TWICE.name, (TWICE,)), 0.0),))
    model = promising(fit, weigh_alternatives(fit, [told], []))
    tips = model.tip(FRESH, Context())
    stored = store(model)
    back = restore(stored, ARM, "model.yaml")
    mine, theirs = (expected_miss(m, FRESH, Context(), tips) for m in (model, back))
    assert len(mine.chance) == 2
    np.testing.assert_allclose(theirs.apart, mine.apart, atol=1e-8)
    np.testing.assert_allclose(theirs.sizes, mine.sizes, rtol=1e-4)
    assert stored.uncertainty is not None
    stored.uncertainty.alternatives[0].moves[0] = "AAAA"
    with pytest.raises(InputError, match=r"uncertainty\.alternatives"):
        restore(stored, ARM, "model.yaml")


def test_a_diagnosis_tells_the_promise_what_it_left_open() -> None:
    """It names a gear's second order; that it is the first has a chance of one in ten or more."""
    with few_effects((GearEccentricity,)):
        made = la.diagnose(ARM, at_three_positions(), network=False)
    (effect,) = made.diagnosis.explained.found
    assert {c.terms[0].order for c, _ in effect.otherwise} >= {1}
    known = made.model.uncertainty
    assert known is not None
    assert any(t.order != effect.terms[0].order for a in known.alternatives for t in a.terms)
