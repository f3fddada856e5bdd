"""A part beyond its drawing's tolerance: calibration widens its prior, no effect stands for it."""

import dataclasses

import numpy as np
import pytest
from small_arm import ARM
from touching import ARM as TOUCHING
from touching import errors_of_the_drawing, touching

import longarm_comp as la
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.kind_of_arm import KindOfArm
from longarm_comp.core.calibration.linear import CHANCES, SIZES, choose_sizes
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.geometry_errors import DhError
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model

ROW, TOLERANCE_DEG = 3, 0.023


def drawn() -> Arm:
    """The small arm, every angle of its drawing to 0.4 mrad."""
    angle = {"alpha_deg": TOLERANCE_DEG}
    joints = tuple(
        j.model_copy(update={"tolerance": j.tolerance.model_copy(update=angle)}) for j in ARM.joints
    )
    return ARM.model_copy(update={"joints": joints})


def rows_of(arm: Arm, alpha: float, n: int = 150) -> Session:
    """Poses of the arm with one twist that is off, 0.1 mm of noise."""
    rng = np.random.default_rng(4)
    truth = Model(arm, (*declared_model(arm).effects, DhError(ROW, alpha=alpha)))
    q = rng.uniform(arm.lower, arm.upper, (n, arm.n))
    return Session.record(q, truth.tip(q) + 1e-4 * rng.standard_normal((n, 3)))


def calibrated(arm: Arm, rows: Session) -> ModelFit:
    return dict(fit_stages(declared_model(arm), rows))["geometry"]


@pytest.mark.parametrize(("told", "size"), [(0.0, 1.0), (2.0, 1.0), (3.0, 4.0), (30.0, 16.0)])
def test_the_likeliest_size_of_a_coefficient(told: float, size: float) -> None:
    found, chance = choose_sizes(np.array([-told]), np.array([SIZES]), np.array([CHANCES]))
    assert (found[0], chance) == (size, CHANCES[SIZES.index(size)])


def test_a_part_far_beyond_its_tolerance_has_a_wider_prior_alone() -> None:
    arm = drawn()
    fitted = calibrated(arm, rows_of(arm, 12e-3))
    ((identity, times),) = fitted.model.beyond
    (mine,) = (s for s in fitted.slots if s.identity == identity)
    assert (mine.label, times) == (f"dh_error / row {ROW} / alpha", 16.0)
    assert mine.parameter.width == pytest.approx(16.0 * np.radians(TOLERANCE_DEG))
    assert fitted.model.values[fitted.slots.index(mine)] == pytest.approx(12e-3, rel=0.1)


@pytest.mark.parametrize("off_m", [0.3, -0.2])
def test_a_length_far_off_its_drawing_is_found(off_m: float) -> None:
    """Counted as noise, 100 mm would make the drawing worth more than every row."""
    rng = np.random.default_rng(5)
    truth = Model(ARM, (*declared_model(ARM).effects, DhError(3, a=off_m)))
    q = rng.uniform(ARM.lower, ARM.upper, (80, ARM.n))
    rows = Session.record(q, truth.tip(q) + 1e-4 * rng.standard_normal((80, 3)))
    fitted = calibrated(ARM, rows)
    assert dict(fitted.model.beyond)["dh_error", ("row", 3), "a"] == SIZES[-1]
    np.testing.assert_allclose(fitted.sigma, 1e-4, rtol=0.3)
    if off_m > 0.0:  # the other is refused before: rows of another arm
        said = la.calibrate(ARM, rows).far_off
        assert any(part.startswith("dh_error / row 3 / a: ") for part in said)


def test_touches_that_hold_no_size_leave_the_arm_as_large_as_drawn() -> None:
    """On a smaller arm every touch misses by less."""
    rows = dataclasses.replace(touching(errors_of_the_drawing(), 72), touch_distances=())
    tips, drawn = (m.tip(rows.q) for m in (calibrated(TOUCHING, rows).model, Model(TOUCHING)))
    assert np.std(tips, axis=0) == pytest.approx(np.std(drawn, axis=0), rel=0.03)


def test_parts_within_their_tolerance_keep_it() -> None:
    arm = drawn()
    assert calibrated(arm, rows_of(arm, 4e-4)).model.beyond == ()


def test_no_effect_stands_for_a_part_beyond_its_tolerance() -> None:
    """Its prior would cost 450 log units; a function that turns the same row costs none."""
    arm = drawn()
    rows = rows_of(arm, 12e-3)
    start = calibrated(arm, rows).model
    offered = list_candidates(arm, rows.context(), None, start.terms).testable
    assert explain_session(start, rows, offered).found == ()


def test_a_kind_counts_errors_in_the_drawings_tolerances() -> None:
    """Whether a model carries its wider priors or was read from a file."""
    arm = drawn()
    models = [calibrated(arm, rows_of(arm, a)).model.lasting() for a in (9e-3, 12e-3, 15e-3)]
    files = [dataclasses.replace(m, beyond=()) for m in models]
    kinds = [KindOfArm.of(arm, made, ["a", "b", "c"]) for made in (models, files)]
    assert kinds[0].rest == pytest.approx(kinds[1].rest)
    for own, other in zip(kinds[0].directions, kinds[1].directions, strict=True):
        assert own.terms == other.terms
