"""What poses that no fit has seen say: more than noise, or what a fit of few rows may err by."""

import dataclasses

import numpy as np
import pytest
from discover_rows import calibrated, measured
from small_arm import ARM

from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.structure import Structure
from longarm_comp.core.identify.structure_tests import with_held_out

NOTHING = Structure(False, 0.5, (), 0.0, 1.0, ())


@pytest.fixture(scope="module")
def few() -> tuple[ModelFit, Session]:
    """A fit of so few rows that its parameters err as much as the noise; other poses."""
    return calibrated(ARM, measured(ARM, (), 14, 5)), measured(ARM, (), 100, 6)


def test_what_parameters_may_err_by_is_no_structure(few: tuple[ModelFit, Session]) -> None:
    fitted, rows = few
    certain = dataclasses.replace(fitted, covariance=np.zeros_like(fitted.covariance))
    assert with_held_out(NOTHING, [(certain, rows)]).flag
    assert not with_held_out(NOTHING, [(fitted, rows)]).flag


def test_an_error_beyond_these_is(few: tuple[ModelFit, Session]) -> None:
    fitted, rows = few
    moved = 3e-3 * np.sign(np.sin(40.0 * rows.q[:, :3]))
    off = dataclasses.replace(rows, xyz=rows.xyz + moved)
    found = with_held_out(NOTHING, [(fitted, off)])
    assert found.flag and found.sign == "shows in the held-out poses"
    assert found.size_m == pytest.approx(3e-3 * np.sqrt(3.0), rel=0.2)
    assert found.p_value < 1e-6


def test_gross_errors_among_them_change_nothing() -> None:
    fitted, rows = calibrated(ARM, measured(ARM, (), 30, 5)), measured(ARM, (), 100, 6)
    gross = np.where(np.arange(len(rows)) % 10 == 0, 0.05, 0.0)
    off = dataclasses.replace(rows, xyz=rows.xyz + gross[:, None])
    assert not with_held_out(NOTHING, [(fitted, off)]).flag
