"""What every arm gives way by: in the model where the rows ask for it, and named nowhere."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from few_effects import names_alone
from touching import ARM

from longarm_comp.core.calibration.candidates import distinct_terms, list_candidates
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance, LinkBending
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.slow_changes import ThermalGrowth
from longarm_comp.core.identify import model_tolerance
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.model_tolerance import (
    BACKGROUND_COMPLIANCE,
    BACKGROUND_REST,
    ModelTolerance,
    background_columns,
    fit_with_background,
)
from longarm_comp.core.identify.proof import CALIBRATED, WITH_EFFECTS
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model, slots_of

NOISE_M = 1e-4
ELASTIC = (JointCompliance, BearingTilt, LinkBending)


def parts() -> tuple[Effect, ...]:
    """All joints, seats and links of a Panda."""
    offered = list_candidates(ARM, rows_of(declared_model(ARM), 4).context()).testable
    return tuple(t for t in distinct_terms(offered) if isinstance(t, Effect) and t.elastic)


def giving_way(size: float) -> Model:
    """An arm whose parts give way by some of what a finding is, each by its own amount."""
    model = declared_model(ARM).plus(*parts())
    draws = np.abs(np.random.default_rng(3).standard_normal(len(model.slots)))
    amounts = [
        size * draw * s.parameter.width if s.owner.elastic else 0.0
        for draw, s in zip(draws, model.slots, strict=True)
    ]
    return model.with_values(np.array(amounts))


def rows_of(model: Model, count: int, seed: int = 5) -> Session:
    """Positions that a tracker saw."""
    rng = np.random.default_rng([seed, count])
    q = ARM.lower + (ARM.upper - ARM.lower) * rng.random((count, ARM.n))
    return Session.record(q, model.tip(q) + NOISE_M * rng.standard_normal((count, 3)))


@cache
def found(size: float) -> Diagnosis:
    """The diagnosis of such an arm, functions and all."""
    true = giving_way(size)
    return diagnose(ARM, rows_of(true, 120), test=rows_of(true, 60, seed=6))


def test_the_parts_are_joints_seats_and_links() -> None:
    assert {t.name for t in parts()} == {"joint_compliance", "bearing_tilt", "link_bending"}
    assert len(parts()) == 7 + 7 + 5


def test_all_else_is_less_off_than_what_gives_way_however_many_forms_and_names_it_has() -> None:
    fitted = found(0.0).explained.fit
    columns, offered = FitColumns(fitted), found(0.0).explained.candidates
    assert {"backlash", "servo_deadband"} < {c.name for c in offered}, "one physics, two names"
    every = [t for t in distinct_terms(offered) if t.name not in ("servo_deadband", "servo_droop")]
    white, by_slack = background_columns(
        columns, offered, [ModelTolerance(0.01, share) for share in (1.0, 16.0)]
    )
    np.testing.assert_allclose(white, columns.white_columns(every))
    elastic = {t.key: t.elastic for t in every}
    for times, sizes in zip((1.0, 16.0), by_slack, strict=True):
        of_place: dict[tuple[object, str], float] = {}
        for size, slot in zip(sizes, slots_of(ARM, every), strict=True):
            place = slot.owner.key, slot.parameter.name
            of_place[place] = of_place.get(place, 0.0) + size**2
        for (key, _), square in of_place.items():
            assert np.sqrt(square) == pytest.approx(
                times * BACKGROUND_COMPLIANCE if elastic[key] else BACKGROUND_REST
            )


def test_a_little_of_everything_is_in_the_model_and_no_finding() -> None:
    """It takes off what calibration leaves, and its priors are far below a finding's."""
    diagnosis = found(BACKGROUND_COMPLIANCE)
    assert diagnosis.explained.tolerance.compliance
    assert diagnosis.findings == ()
    assert diagnosis.written == WITH_EFFECTS
    elastic = [s for s in diagnosis.model.slots if s.owner.elastic]
    assert len(parts()) / 2 < len({s.owner.key for s in elastic}) < len(parts()), "what is seen"
    bare = dataclasses.replace(diagnosis.model, beyond=())
    for slot, usual in zip(diagnosis.model.slots, bare.slots, strict=True):
        if slot.owner.elastic:
            assert slot.parameter.width == pytest.approx(
                BACKGROUND_COMPLIANCE * usual.parameter.width
            )
    test = rows_of(giving_way(BACKGROUND_COMPLIANCE), 60, seed=7)
    left = {
        name: np.linalg.norm(compute_tip_errors(fit.model, test), axis=1).mean()
        for name, fit in diagnosis.fits.items()
    }
    assert left[WITH_EFFECTS] < 0.7 * left[CALIBRATED]


def test_a_rigid_arm_stays_rigid() -> None:
    diagnosis = found(0.0)
    assert not diagnosis.explained.tolerance.compliance
    assert diagnosis.written == CALIBRATED
    assert not any(s.owner.elastic for s in diagnosis.model.slots)
    assert "a little" not in diagnosis.summary
    assert (diagnosis.verdict, diagnosis.findings) == ("noise", ()), "among all names"


def test_what_else_is_off_is_in_the_model_too_and_what_is_not_stays_out() -> None:
    """Gains of two joints, each too small to be a finding."""
    off = declared_model(ARM).plus(JointGain(2, gain=2e-4), JointGain(4, gain=2e-4))
    kinds = (JointGain, GearEccentricity, *ELASTIC)
    diagnosis = diagnose(ARM, rows_of(off, 120), test=rows_of(off, 60, seed=6), kinds=kinds)
    assert diagnosis.verdict == "noise"
    added = {t.key for t in diagnosis.model.terms if not t.geometry and not t.elastic}
    assert {("joint_gain", "joint 2"), ("joint_gain", "joint 4")} <= added and len(added) < 6


def test_what_gives_way_is_kept_where_it_may_for_another_load() -> None:
    """A part whose best value is none may still yield: a promise under another load counts it."""
    fitted = fit_with_background(
        found(BACKGROUND_COMPLIANCE).explained.fit,
        found(BACKGROUND_COMPLIANCE).explained.candidates,
    )
    elastic = [s for s in fitted.model.slots if s.owner.elastic]
    assert any(s.value < 1e-3 * s.parameter.width for s in elastic)
    sure = fitted.standard_errors[[fitted.slots.index(s) for s in elastic]]
    assert (sure > 0.0).all()


@pytest.mark.long
def test_an_arm_of_which_every_part_is_soft_has_no_soft_part() -> None:
    """Its parts yield by half of what a finding does: no name, and the model holds them."""
    diagnosis = found(0.5)
    assert diagnosis.explained.tolerance.is_soft
    assert not [f for f in diagnosis.findings if f.probability >= 0.95 and not f.open]
    test = rows_of(giving_way(0.5), 60, seed=7)
    left = np.linalg.norm(compute_tip_errors(diagnosis.model, test), axis=1).mean()
    assert left < 3.0 * NOISE_M


def test_what_is_a_little_off_needs_no_recorded_column(monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm that grows when warm is no reason to ask every command for the temperature."""
    rows = rows_of(giving_way(BACKGROUND_COMPLIANCE), 120)
    warmth = 20.0 + 8.0 * np.sin(np.arange(120) / 9.0)
    grown = rows.xyz * (1.0 + 1.1e-5 * (warmth - 20.0)[:, None])
    rows = dataclasses.replace(rows, xyz=grown, columns={"temperature_c": warmth})
    kinds = (ThermalGrowth, JointGain, *ELASTIC)
    with names_alone():
        made = diagnose(ARM, rows.take(slice(90)), test=rows.take(slice(90, 120)), kinds=kinds)
    explained = made.explained
    assert "thermal_growth" in {c.name for c in explained.candidates}
    # now its column would move the rows
    monkeypatch.setattr(model_tolerance, "BACKGROUND_REST", 1.0)
    added = fit_with_background(explained.fit, explained.candidates).model.effects
    assert "joint_gain" in {t.name for t in added}
    assert not any("temperature_c" in t.inputs for t in added)


def test_the_sentence_says_that_parts_are_off() -> None:
    assert "a little off" in found(BACKGROUND_COMPLIANCE).summary


def test_what_is_said_of_a_finding_beside_it_is_what_is_written() -> None:
    """One fit of both: without what gives way, the gain would be another."""
    true = giving_way(BACKGROUND_COMPLIANCE).plus(JointGain(2, gain=0.01))
    rows, test = rows_of(true, 120), rows_of(true, 60, seed=6)
    with names_alone():
        diagnosis = diagnose(ARM, rows, test=test, kinds=(JointGain, *ELASTIC))
    assert diagnosis.explained.tolerance.compliance
    (gain,) = (f for f in diagnosis.findings if f.name == "joint_gain")
    written = {t.key: t for t in diagnosis.model.terms}
    assert [written[t.key] for t in gain.terms] == list(gain.terms)
    assert [p.value for p in gain.parameters] == [t.gain for t in gain.terms]
