"""Poses that split a set: how much they are expected to tell."""

import dataclasses

import numpy as np
import pytest
from drawn_reports import in_doubt
from read_arm import ARM

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import prior_widths
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.masses import TipPayload
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.planning.splitting_poses import SplittingPoses, choose_splitting_poses


def asked(count: int, share: float = 1.0) -> SplittingPoses:
    """Poses between the first two names of a set, its effect so many times as large."""
    explained = in_doubt().explained
    (found,) = in_doubt().findings
    keys = {t.key for t in found.terms}
    model = explained.fit.model
    own = np.array([s.owner.key in keys for s in model.slots])
    values = np.where(own, share * model.values, model.values)
    fitted = dataclasses.replace(explained.fit, model=model.with_values(values))
    rival = next(r for r in found.alternatives if r.candidate.name not in found.names[1:2])
    return choose_splitting_poses(fitted, found.candidate, rival.candidate, count)


def test_an_effect_of_nothing_tells_nothing() -> None:
    assert asked(2, share=0.0).log_bayes_factor == pytest.approx(0.0, abs=1e-9)


def test_the_odds_grow_with_the_square_of_the_effect_and_with_poses() -> None:
    one = asked(4).log_bayes_factor
    assert one > 0.0
    assert asked(4, share=3.0).log_bayes_factor == pytest.approx(9.0 * one, rel=1e-2)
    assert asked(8).log_bayes_factor > one


def test_the_odds_of_the_rows_alone_are_half_the_square_of_what_nothing_else_explains() -> None:
    fitted = in_doubt().explained.fit
    (found,) = in_doubt().findings
    keys = {t.key for t in found.terms}
    own = [s for s in fitted.slots if s.owner.key in keys]
    values = np.array([s.value for s in own]) / prior_widths(tuple(own))
    columns = FitColumns(fitted)
    rival = next(r for r in found.alternatives if r.candidate.name not in found.names[1:2])
    alone = columns.marginal_without(keys)
    beside = columns.white_columns(rival.candidate.terms)
    besides = Marginal(np.concatenate([alone.a, beside], axis=1), alone.y)
    left = besides.project_products(
        (columns.white_columns([s.owner for s in own]) @ values)[:, None]
    )[0]
    assert asked(0).log_bayes_factor == pytest.approx(0.5 * float(left[0, 0]), rel=1e-5)


def test_a_payload_that_arm_yaml_declares_is_taken_off_at_some_poses() -> None:
    """The rows carried it, so they tell what it weighs only together with what yields."""
    carried = {**ARM.model_dump(exclude_defaults=True), "payload": {"mass_kg": 0.4, "frame": 4}}
    arm = Arm.parse(carried, "loaded arm")
    compliance, weight = JointCompliance.for_arm(arm)[1], TipPayload.for_arm(arm)[0]
    model = declared_model(arm).plus(JointZero.for_arm(arm)[1], compliance)
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (40, arm.n))
    true = model.with_values(np.full(len(model.slots), 4e-3))
    fitted = fit_model(model, Session.record(q, true.tip(q)))
    found, other = (Candidate(t.name, (t,)) for t in (fitted.model.terms[-1], weight))
    poses = choose_splitting_poses(fitted, found, other, 6)
    assert poses.payload_kg is not None and 0.0 in poses.payload_kg
