"""What is on offer to the posterior: priors of names, functions, forms; who is alike."""

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import pytest
from demo_rows import session_of
from discover_rows import DEMO, ROWS, calibrated, measured
from hidden_arm import at
from scipy.special import expit
from small_arm import ARM as SMALL

from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.candidates import Candidate, list_candidates
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import SIZES, Marginal
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance, ServoDroop
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.drive_errors import (
    GearEccentricity,
    JointGain,
    ServoQuantisation,
)
from longarm_comp.core.effects.effect import Effect, parameter
from longarm_comp.core.effects.joint_term import joint_load
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.masses import GravityDirection
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.effects.typical_loads import typical_loads
from longarm_comp.core.identify.discover.functions import FunctionFamily
from longarm_comp.core.identify.intervals import LOOSE
from longarm_comp.core.identify.model_tolerance import RIGID, ModelTolerance
from longarm_comp.core.identify.posterior.explained import widen_prior
from longarm_comp.core.identify.posterior.found import FoundEffect, ProposedFunction, replace_effect
from longarm_comp.core.identify.posterior.offer_bank import OfferBank
from longarm_comp.core.identify.posterior.offered_effects import OfferedEffects
from longarm_comp.core.identify.posterior.offers import AMPLITUDES, make_offers, tolerance_columns
from longarm_comp.core.identify.posterior.proposed_functions import propose_functions
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden import drives
from studies.outside import PumpShake, RubberStop

KINDS = (JointCompliance, JointGain, GearEccentricity, ServoDroop)


def chance(bank: OfferedEffects, *names: str) -> float:
    return sum(math.exp(o.log_prior) for o in bank.bank.offers if o.name in names)


def test_effects_have_the_same_evidence_with_and_without_others_on_offer() -> None:
    """A second place of a name cost ten times more where only what was found was on offer."""
    rows = session_of(DEMO, 2)
    tried = list_candidates(DEMO, rows.context(), KINDS).testable
    gains = [c.terms for c in tried if c.name == "joint_gain" and len(c.terms) == 1][:2]
    found = tuple(FoundEffect.of(terms, 1.0, 0.0) for terms in gains)
    terms = (*geometry_terms(DEMO, rows), *(t for own in gains for t in own))
    fitted = fit_model(Model(DEMO, terms), rows)
    among, alone = (
        make_offers(fitted, tried, (), found, [ModelTolerance(0.01, False)], others=others)[0]
        for others in (True, False)
    )
    assert len(alone.bank.offers) < len(among.bank.offers)
    assert alone.evidence_of_known == pytest.approx(among.evidence_of_known)


def test_every_name_is_as_likely_and_functions_have_a_twentieth() -> None:
    rows = session_of(DEMO, 2)
    fitted = fit_model(Model(DEMO, (LinkDeflection(), *geometry_terms(DEMO, rows))), rows)
    tried = list_candidates(DEMO, rows.context(), KINDS, fitted.model.terms).testable
    terms = [Discovered("joint 5", "turn z", f"legendre(q5, {k}.0)", "q5 -1..1") for k in (2, 3)]
    functions = [ProposedFunction((t,), math.log(0.5)) for t in terms]
    bank = make_offers(fitted, tried, functions, (), [ModelTolerance(0.01, False)])[0]
    shares = [chance(bank, name) for name in ("joint_compliance", "joint_gain", "servo_droop")]
    assert shares == pytest.approx([0.95 / 4] * 3)
    assert chance(bank, "discovered") == pytest.approx(0.05)
    forms = [o for o in bank.bank.offers if o.name == "joint_gain"]
    assert len(forms) > 1
    assert len({o.log_prior for o in forms}) == 1
    assert bank.known == ()
    assert bank.evidence_of_known == pytest.approx(bank.base)


@dataclasses.dataclass(frozen=True)
class SmallGain(JointGain):
    """That is hardly possible."""

    name: ClassVar[str] = "small_gain"

    gain: float = parameter("1", "extra motion", prior=0.05, lower=-0.01, upper=0.02)


def test_an_offer_pays_for_its_form_and_keeps_to_its_bounds() -> None:
    rows = session_of(DEMO, 2)
    fitted = fit_model(Model(DEMO, (LinkDeflection(),)), rows)
    odd = ServoQuantisation.of_step(DEMO, 1, 0.01)
    tried = [Candidate(t.name, (t,)) for t in (odd, SmallGain(2))]
    bank = make_offers(fitted, tried, (), (), [ModelTolerance(0.01, False)])[0].bank
    assert bank.offers[0].log_prior == pytest.approx(math.log(0.95 / 2) - odd.price(DEMO))
    (k,) = bank.offers[1].column_numbers
    of = bank.coefficients
    assert (of.lower[k], of.upper[k]) == (pytest.approx(-0.2), pytest.approx(0.4))


def planted(seed: int = 2) -> tuple[ModelFit, FoundEffect]:
    rows = session_of(DEMO, seed, JointGain(5, gain=0.04))
    model = Model(DEMO, (LinkDeflection(), *geometry_terms(DEMO, rows))).plus(JointGain(5))
    fitted = fit_model(model, rows, sigma=np.full(3, 4e-4))
    (term,) = (t for t in fitted.model.terms if isinstance(t, JointGain))
    found = FoundEffect.of((term,), 1.0, 200.0)
    return fitted, found


def test_what_is_in_the_model_is_weighed_as_if_it_were_not() -> None:
    """The evidence of the effect that was fitted is that of a model without it and with it."""
    fitted, found = planted()
    kinds = list_candidates(DEMO, fitted.session.context(), (JointGain,)).testable
    bank = make_offers(fitted, kinds, (), (found,), [ModelTolerance(0.0, False)])[0]
    (known,) = bank.known
    assert bank.bank.offers[known].keys == (found.terms[0].key,)
    assert bank.evidence_of_known > bank.base + 100.0
    explained = bank.find_best()
    assert [t.where for f in explained.found for t in f.terms] == ["joint 5"]
    assert explained.found[0].terms[0].gain == pytest.approx(0.04, rel=0.1)  # type: ignore[union-attr]
    assert explained.evidence == pytest.approx(bank.evidence_of_known, abs=0.5)


def test_a_form_that_moved_off_the_library_stays_on_offer() -> None:
    fitted, found = planted()
    other = [Candidate("joint_gain", (JointGain(2),))]
    bank = make_offers(fitted, other, (), (found,), [ModelTolerance(0.0, False)])[0]
    assert [bank.candidates[n].where for n in bank.known] == [("joint 5",)]
    assert bank.bank.offers[bank.known[0]].log_prior == pytest.approx(math.log(0.95))


def test_a_form_may_err_by_a_share_of_its_own_shift() -> None:
    """RMS of the tolerance's columns together: the share, of every effect's own shift."""
    fitted, found = planted()
    assert tolerance_columns(fitted, (), (), ModelTolerance(0.1, False)).shape[1] == 0
    small, large = (
        tolerance_columns(fitted, (), (found,), ModelTolerance(t, False)) for t in (0.01, 0.1)
    )
    np.testing.assert_allclose(large, 10.0 * small)
    (k,) = (i for i, s in enumerate(fitted.slots) if isinstance(s.owner, JointGain))
    shift = fitted.columns[..., k] * fitted.model.values[k]
    white = fitted.whiten_columns(shift[..., None])[:, 0]
    ratio = np.sqrt((large**2).sum() / (white**2).sum())
    assert ratio == pytest.approx(0.1, rel=0.5)
    assert np.linalg.norm(large[np.abs(white) < 1e-12]) == pytest.approx(0.0, abs=1e-9)


def test_what_every_arm_has_is_there_and_no_finding() -> None:
    """A lean of 5 mrad about each axis, on top of which one of 30 must explain something."""
    fitted, _ = planted()
    columns, leaning = FitColumns(fitted), Candidate("gravity_direction", (GravityDirection(),))
    usual = tolerance_columns(fitted, [leaning], (), ModelTolerance(0.1, False))
    size = 5e-3 / prior_widths(leaning.slots(DEMO))
    lean = fitted.whiten_columns(columns.prior_columns(leaning.terms) * size)
    np.testing.assert_allclose(usual, lean, atol=1e-9)
    bank = make_offers(fitted, [leaning], (), (), [ModelTolerance(0.1, False)])[0]
    whole = Marginal(np.concatenate([fitted.design, usual], axis=1), fitted.data)
    assert bank.base == pytest.approx(whole.evidence)
    assert (
        bank.bank.gram[0, 0]
        < 0.9 * (fitted.whiten_columns(columns.prior_columns(leaning.terms))[:, 0] ** 2).sum()
    )


def test_what_its_own_form_may_leave_has_less_evidence() -> None:
    """A tolerance of a tenth marginalises what a hundredth counts as structure."""
    fitted, found = planted()
    kinds = list_candidates(DEMO, fitted.session.context(), KINDS).testable
    wide, narrow = (
        make_offers(fitted, kinds, (), (found,), [ModelTolerance(t, False)])[0].evidence_of_known
        for t in (0.1, 0.01)
    )
    assert wide < narrow


@dataclasses.dataclass(frozen=True)
class Twin(JointCompliance):
    """The same physics by another name."""

    name: ClassVar[str] = "twin"
    aliases: ClassVar[tuple[str, ...]] = ()


def explained_by(rows: Session, *terms: Effect) -> tuple[ModelFit, tuple[FoundEffect, ...]]:
    """A fit with some effects, each found by itself."""
    model = Model(DEMO, (LinkDeflection(), *geometry_terms(DEMO, rows))).plus(*terms)
    fitted = fit_model(model, rows, sigma=np.full(3, 4e-4))
    held = {t.key: t for t in fitted.model.terms}
    found = (FoundEffect.of((held[t.key],), 1.0, 200.0) for t in terms)
    return fitted, tuple(found)


def judged(
    fitted: ModelFit,
    kinds: Sequence[Candidate],
    found: tuple[FoundEffect, ...],
    *tried: float,
) -> dict[str, FoundEffect]:
    """By name, with forms that err by any of some shares."""
    banks = make_offers(fitted, kinds, (), found, [ModelTolerance(t, False) for t in tried])
    again, _ = max(banks, key=lambda b: b.evidence_of_known).judge_found(found, banks)
    return {f.name: f for f in again}


def everywhere(kind: type[JointCompliance]) -> Candidate:
    return Candidate(kind.name, tuple(kind(row) for row in kind.rows(DEMO)))


def test_names_that_no_measurement_distinguishes_share_evenly() -> None:
    rows = session_of(DEMO, 1, JointCompliance(2, compliance=8e-3))
    fitted, found = explained_by(rows, JointCompliance(2))
    kinds = list_candidates(DEMO, rows.context(), KINDS).testable
    soft = judged(fitted, kinds, found, 0.01)["joint_compliance"]
    chances = soft.names
    assert chances["joint_compliance"] == pytest.approx(chances["servo_droop"], rel=1e-6)
    assert sum(chances.values()) == pytest.approx(1.0)
    assert soft.fitted_rivals == []
    (droop,) = [r for r in soft.rivals if r.name == "servo_droop"]
    assert (droop.judged, droop.unnamed) == ("joint_compliance", False)
    assert droop.log_bayes_factor == pytest.approx(soft.log_bayes_factor)
    (bank,) = make_offers(fitted, kinds, (), found, [ModelTolerance(0.01, 0.0)])
    (quick,) = (f for f in bank.find_with_names() if "joint_compliance" in f.names)
    assert sum(quick.names.values()) == pytest.approx(1.0)
    assert quick.names["servo_droop"] == pytest.approx(quick.names["joint_compliance"], rel=1e-6)


def test_so_do_those_that_stand_in_the_place_of_another() -> None:
    """Of a rival and its own look-alike one is judged, by a fit, and both have half of it."""
    rows = session_of(DEMO, 1, JointCompliance(2, compliance=8e-3))
    fitted, found = explained_by(rows, Twin(2))
    kinds = list_candidates(DEMO, rows.context(), KINDS).testable
    twin = judged(fitted, kinds, found, 0.01)["twin"]
    one_name = [c for c in kinds if c.name != "servo_droop"]
    alone = judged(fitted, one_name, found, 0.01)["twin"].names
    names = len({c.name for c in kinds})  # every name is as likely as any other
    both = 2 * twin.names["joint_compliance"] / twin.names["twin"] * names
    assert both == pytest.approx(alone["joint_compliance"] / alone["twin"] * (names - 1), rel=1e-3)
    for made in (twin, twin.compare_with({"joint_compliance": -0.5})[0]):
        chances = made.names
        assert chances["joint_compliance"] == pytest.approx(chances["servo_droop"], rel=1e-6)
    assert chances["joint_compliance"] / chances["twin"] == pytest.approx(np.exp(-0.5) / 2)
    factors = {r.name: r.log_bayes_factor for r in twin.rivals}  # priors apart, the same physics
    assert factors["joint_compliance"] == pytest.approx(twin.log_bayes_factor, abs=1e-3)
    judged_ones = [r.name for r in twin.fitted_rivals]
    assert "joint_compliance" in judged_ones and "servo_droop" not in judged_ones


def test_a_family_pays_for_the_choice_of_the_joints_that_it_needs() -> None:
    """Offered at every joint, true at one: the same physics is offered there alone."""
    rows = session_of(DEMO, 1, JointCompliance(2, compliance=8e-3))
    fitted, found = explained_by(rows, JointCompliance(2))
    soft = judged(fitted, [everywhere(Twin), everywhere(JointCompliance)], found, 0.01)[
        "joint_compliance"
    ]
    choice = len(everywhere(Twin).terms)
    assert soft.names["twin"] == pytest.approx(1.0 / (1.0 + choice), rel=0.01)
    (rival,) = soft.fitted_rivals
    assert rival.candidate.where == ("joint 2",), "only what it needs is fitted"


def test_a_name_that_is_there_takes_a_further_place_as_one_effect() -> None:
    """Two soft joints of one name are likelier than of two names."""
    true = (JointCompliance(2, compliance=8e-3), JointCompliance(4, compliance=8e-3))
    rows = session_of(DEMO, 1, *true)
    fitted, found = explained_by(rows, Twin(2), JointCompliance(4))
    twin = judged(fitted, [everywhere(JointCompliance)], found, 0.01)["twin"]
    assert twin.names["joint_compliance"] > 0.9
    assert [f.name for f in replace_effect(found, 0, found[1])] == ["joint_compliance"]


def test_what_a_larger_error_of_a_form_explains_is_in_doubt() -> None:
    """With forms of larger error, nearly as likely, nothing is left that asks for the effect."""
    fitted, found = planted()
    narrow = make_offers(fitted, (), (), (found,), [ModelTolerance(0.01, False)])[0]
    of = narrow.bank
    blind = OfferBank(of.offers, 0 * of.gram, 0 * of.along, of.coefficients)
    wide = dataclasses.replace(narrow, bank=blind, base=narrow.evidence_of_known - 1.0)
    ((alone,), _) = narrow.judge_found((found,), [narrow])
    ((doubted,), _) = narrow.judge_found((found,), [narrow, wide])
    assert alone.presence > 0.999
    assert doubted.presence == pytest.approx(expit(1.0))


def test_a_row_at_a_threshold_says_nothing_of_its_side() -> None:
    """The threshold's tolerance frees each row alone whose load is as near, and no other."""
    play = Backlash(4, gate=0.1, blend=0.01, width=0.02)
    rows = session_of(DEMO, 2, play)
    fitted, found = explained_by(rows, play)
    every = tolerance_columns(fitted, (), found, ModelTolerance(0.05, False))
    touched = (every.reshape(len(rows), 3, -1) != 0).any(axis=1)
    free = touched[:, touched.sum(axis=0) == 1]
    load = np.abs(joint_load(fitted.posture, 4)) / typical_loads(DEMO).torque
    off = np.abs(load / 0.1 - 1.0)
    assert free.any(axis=1)[off < 0.04].sum() >= 3
    assert not free.any(axis=1)[off > 0.07].any()


# ------------------------------------------------------------------ functions on offer


def test_functions_on_offer_are_the_best_and_none_is_of_geometry() -> None:
    fitted = calibrated(SMALL, measured(SMALL, (PumpShake(sway=2e-3, waves=6.0),), ROWS, 3))
    made = propose_functions(fitted, ())
    assert 0 < len(made) <= 60
    assert any("pump_bar" in t.function for t in made[0].terms)  # type: ignore[union-attr]
    still = [p for p in made if all(t.function == "1" for t in p.terms)]  # type: ignore[union-attr]
    for p in still:
        assert not any(t.where.split(", ")[1].startswith(("move", "turn")) for t in p.terms)


def test_a_joint_far_off_its_zero_is_no_function() -> None:
    """Fifteen tolerances: a constant turn of the joint would have much evidence."""
    rows = measured(SMALL, (), ROWS, 3)
    moved = dataclasses.replace(rows, q=rows.q + np.array([0.0, 0.06, 0.0, 0.0]))
    for p in propose_functions(calibrated(SMALL, moved), ()):
        parts = {t.where.split(", ")[1][:4] for t in p.terms}
        assert not ({t.function for t in p.terms} == {"1"} and parts <= {"move", "turn"})  # type: ignore[union-attr]


def test_functions_are_on_offer_in_the_place_of_what_was_found() -> None:
    """On top of the gain nothing is left to explain."""
    rows = measured(SMALL, (drives.JointGain(at(2, 0.02)),), ROWS, 3)
    bare = calibrated(SMALL, rows)
    whole = fit_model(bare.model.plus(JointGain(2)), rows)
    named = FoundEffect.of((JointGain(2),), 1.0, 200.0)
    made = [propose_functions(whole, found) for found in ((), (named,))]
    same = [any(t.place == "joint 2, turn z, linear(q2)" for p in m for t in p.terms) for m in made]
    assert same == [False, True]


def test_no_function_is_on_offer_in_the_place_of_what_gives_way() -> None:
    """Under another load a function does not know by how much."""
    rows = session_of(DEMO, 1, JointCompliance(2, compliance=2e-2))
    whole = fit_model(calibrated(DEMO, rows).model.plus(JointCompliance(2)), rows)
    found = [FoundEffect.of((JointCompliance(2),), 1.0, 200.0)]
    assert JointCompliance.elastic and not propose_functions(whole, found)


def test_the_curve_of_a_joint_is_on_offer_in_the_place_of_a_gear() -> None:
    """Beside much that explains more in the place of what is larger, and at its own price."""
    gear = drives.GearEccentricity(np.stack([at(2, 2e-2), 0.0 * at(2, 1.0)]), np.full((2, 4), 0.7))
    rows = measured(SMALL, (drives.JointGain(at(1, 0.05)), gear), ROWS, 3)
    bare = calibrated(SMALL, rows)
    whole = fit_model(bare.model.plus(JointGain(1), GearEccentricity(2)), rows)
    known = {t.name: t for t in whole.model.effects}
    found = [FoundEffect.of((known[n],), 1.0, 200.0) for n in ("joint_gain", "gear_eccentricity")]
    curves = {
        p.log_prior: p.terms
        for p in propose_functions(whole, found)
        if {t.where for t in p.terms} == {"joint 2, turn z"} and len(p.terms) == 5
    }
    own = curves[-math.log(len(FunctionFamily) * SMALL.n)]
    scales = [t.scale for t in own]  # type: ignore[union-attr]
    assert [t.function for t in own] == [f"legendre(q2, {n}.0)" for n in range(1, 6)]  # type: ignore[union-attr]
    assert scales == sorted(scales, reverse=True)


def test_a_unit_of_a_functions_prior_moves_the_rows_by_one_noise() -> None:
    fitted = calibrated(
        SMALL, measured(SMALL, (RubberStop(joint=1, begins=0.8, holds=0.1),), ROWS, 3)
    )
    (term,) = next(p.terms for p in propose_functions(fitted, ()) if len(p.terms) == 1)
    inside = fitted.weights > 0
    white = FitColumns(fitted).prior_columns([term])[inside, :, 0] / fitted.sigma
    assert np.sqrt((white**2).sum() / inside.sum()) == pytest.approx(1.0, rel=0.02)


def test_a_function_that_was_found_has_a_wide_prior_instead_of_amplitudes() -> None:
    term = Discovered("joint 2", "turn z", "linear(q2)", "q2 0..1", 1e-4, 2e-3)
    found = FoundEffect.of((term,), 1.0, 20.0)
    wide = widen_prior(found)
    assert [t.scale for t in wide.terms] == [LOOSE * 2e-3]  # type: ignore[union-attr]
    fitted = calibrated(SMALL, measured(SMALL, (), ROWS, 3))
    banks = [make_offers(fitted, (), (), (f,), [RIGID])[0].bank for f in (found, wide)]
    assert [offer.sizes for bank in banks for offer in bank.offers] == [AMPLITUDES, SIZES]
    named = FoundEffect.of((JointGain(2),), 1.0, 20.0)
    assert widen_prior(named) is named


def test_what_was_found_keeps_the_price_of_its_choice() -> None:
    """A function among many is no likelier because it is in the model by now."""
    rows = session_of(DEMO, 1, JointCompliance(2, compliance=8e-3))
    fitted, (found,) = explained_by(rows, JointCompliance(2))
    (cause,) = found.causes
    paid = dataclasses.replace(found, causes=(dataclasses.replace(cause, log_prior=-11.0),))
    (bank,) = make_offers(fitted, (), (), (paid,), [ModelTolerance(0.01, False)])
    assert [bank.bank.offers[k].log_prior for k in bank.known] == [-11.0]
