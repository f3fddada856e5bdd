"""What is left in the residual: structure that moves one axis only does not hide among three."""

import dataclasses

import numpy as np
import pytest
from cobot import arm
from numpy.polynomial.legendre import Legendre
from small_arm import ARM, measured

from longarm_comp.core.calibration.calibrate import declared_model, fit_stages
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.reading_steps import find_step
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.structure import (
    SIGNIFICANT,
    Structure,
    cause_probability,
    find_structure,
    smooth_functions,
)
from longarm_comp.core.identify.structure_tests import with_left_out
from longarm_comp.core.model.model import Model

SIGMA = 1e-4
"""Noise of `measured`, m."""
SIZE = 0.75 * SIGMA
"""RMS of the structure: along one axis certain, among three axes p is 0.007 to 0.02."""
AXIS = np.array([1.0, 0.0, 0.0])


def left(seed: int, *sizes: float) -> Structure:
    """Of 120 poses whose x is off by functions of the first joints, no geometry error's."""
    rows = measured(120, np.random.default_rng(seed))
    share = (rows.q - ARM.lower) / (ARM.upper - ARM.lower)
    waves = Legendre.basis(5)(2.0 * share[:, : len(sizes)] - 1.0)
    wave = (waves / np.sqrt((waves**2).mean(axis=0))) @ sizes
    off = dataclasses.replace(rows, xyz=rows.xyz + np.outer(wave, AXIS))
    *_, (_, fitted) = fit_stages(declared_model(ARM), off)
    return find_structure(fitted, fitted)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_what_moves_one_axis_shows_beside_the_noise_of_the_others(seed: int) -> None:
    found = left(seed, SIZE)
    assert found.flag
    assert found.inputs[0] == "q1"
    assert found.size_m == pytest.approx(SIZE, rel=0.6)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_noise_leaves_none(seed: int) -> None:
    assert not left(seed, 0.0).flag


@pytest.mark.parametrize(("second", "named"), [(2.0, False), (4.0, True)])
def test_what_is_much_weaker_than_the_strongest_is_not_named(second: float, named: bool) -> None:
    """It is as certain where it stands alone."""
    assert "q2" in left(2, 0.0, second * SIGMA).inputs
    assert ("q2" in left(2, 4.0 * SIGMA, second * SIGMA).inputs) is named


def test_smooth_functions_are_polynomials_of_rising_degree() -> None:
    """The first ones were any mixture: a line with the temperature was lost in three of four."""
    rng = np.random.default_rng(0)
    for values in (rng.uniform(20.0, 30.0, 240), rng.integers(0, 4, 200) * 0.3):
        made = smooth_functions(values)
        np.testing.assert_allclose(made.T @ made / len(values), np.eye(made.shape[1]), atol=1e-9)
        for k, column in enumerate(made.T):
            power = np.polynomial.Polynomial.fit(values, column, k + 1)
            np.testing.assert_allclose(power(values), column, atol=1e-9)
        assert np.corrcoef(made[:, 0], values)[0, 1] == pytest.approx(1.0)


def test_what_follows_a_recorded_column_in_a_line_shows() -> None:
    rows = measured(120, np.random.default_rng(3))
    warmth = np.random.default_rng(4).uniform(20.0, 30.0, 120)
    line = (warmth - warmth.mean()) / warmth.std()
    off = dataclasses.replace(
        rows,
        xyz=rows.xyz + 0.6 * SIGMA * np.outer(line, AXIS),
        columns={**rows.columns, "temperature_c": warmth},
    )
    *_, (_, fitted) = fit_stages(declared_model(ARM), off)
    found = find_structure(fitted, fitted)
    assert found.flag and found.inputs[0] == "temperature_c"
    assert found.share_explained == 0.0  # no effect was added to the geometry


STEP = 2e-3
"""Of the encoder of joint 1, rad."""


def read(off_steps: float) -> Structure:
    """Of 120 poses at which joint 1 stands a little more than a step further each, and is read.

    What rounding leaves then grows and falls back twice. The joint is off besides by a function of
    its place.
    """
    rng = np.random.default_rng(8)
    q = ARM.lower + rng.random((120, ARM.n)) * (ARM.upper - ARM.lower)
    q[:, 0] = STEP * (1 + 2 / 120) * (np.arange(120) - 60)
    off = off_steps * STEP * np.cos(q[:, 0] * np.pi / np.ptp(q[:, 0]) * 3.0)
    told = {"read_q1": (np.rint((q[:, 0] + off) / STEP) * STEP)[:, None]}
    xyz = Model(ARM).tip(q) + SIGMA * rng.standard_normal((120, 3))
    *_, (_, fitted) = fit_stages(declared_model(ARM), Session.record(q, xyz, readings=told))
    return find_structure(fitted, fitted)


def test_the_pattern_of_rounded_readings_is_no_structure_and_more_than_steps_is() -> None:
    assert not read(0.0).flag
    found = read(3.0)
    assert found.flag and found.inputs[0] == "q1"


def test_the_step_of_readings_is_their_common_divisor() -> None:
    counts = np.random.default_rng(1).integers(-20000, 20000, 100)
    assert find_step(0.31 + counts * 7.67e-5) == pytest.approx(7.67e-5, rel=1e-6)
    assert find_step(np.round(0.31 + counts * 7.67e-5, 7)) == pytest.approx(7.67e-5, rel=1e-3)
    assert find_step(np.random.default_rng(1).random(100)) < 1e-5
    assert find_step(np.array([0.2, 0.2])) == find_step(np.array([])) == 0.0


def test_a_p_value_is_not_taken_for_the_probability_of_no_cause() -> None:
    """Five in a thousand speak for a cause by a factor of fourteen at most."""
    assert cause_probability(0.005) == pytest.approx(0.41, abs=0.01)
    assert 0.99 < cause_probability(1e-6) < 1.0 == cause_probability(0.0)
    assert Structure(False, 0.2, (), 0.0, 1.0).chance == 0.0
    tested = Structure(False, 1.0, (), 0.0, 1.0).add_test(0.005, 1e-3, 1e-4, "rows", "shows")
    assert tested.flag and tested.chance == cause_probability(0.005)


def shared_by_outliers(fitted: ModelFit, shift: float, sides: np.ndarray) -> Structure:
    """Of 24 gross errors of 2 mm among 120 poses, which share a shift (m) along one axis."""
    aside, gross = np.arange(120) % 5 == 0, np.random.default_rng(2).standard_normal((24, 3))
    residual = fitted.residual.copy()
    residual[aside] = 20.0 * SIGMA * (gross - gross.mean(axis=0)) + shift * AXIS
    rows = dataclasses.replace(fitted.session, approach=sides)
    weights = np.where(aside, 0.0, 1.0)
    off = dataclasses.replace(fitted, session=rows, residual=residual, weights=weights)
    return with_left_out(Structure(False, 1.0, (), 0.0, 1.0), off)


def test_what_rows_left_out_share_counts_less_the_more_it_was_sought() -> None:
    """From unknown sides their mean is tried, as is and in the tool's axes; with four sides, six.

    Of these the mean is the likeliest still, and it is three times as likely by chance.
    """
    *_, (_, fitted) = fit_stages(declared_model(ARM), measured(120, np.random.default_rng(2)))
    unknown = np.zeros((120, ARM.n), dtype=np.int8)
    either = np.random.default_rng(3).choice([-1, 1], (120, ARM.n)).astype(np.int8)
    shifts = SIGMA * np.arange(5.0, 40.0)
    first = next(s for s in shifts.tolist() if shared_by_outliers(fitted, s, unknown).flag)
    alone = shared_by_outliers(fitted, first, unknown)
    assert SIGNIFICANT / 3.0 < alone.p_value <= SIGNIFICANT
    assert not shared_by_outliers(fitted, first, either).flag
    tried = shared_by_outliers(fitted, 3.0 * first, either)
    assert tried.flag
    mean = shared_by_outliers(fitted, 3.0 * first, unknown)
    assert tried.p_value == pytest.approx(3.0 * mean.p_value, rel=1e-6)


def test_rows_of_another_reflector_share_a_shift_in_the_tools_axes() -> None:
    """The tool turns every way, so they share none in the axes of the measurements."""
    rng, cobot = np.random.default_rng(2), arm(170)
    q = rng.uniform(cobot.lower, cobot.upper, (120, cobot.n))
    rows = Session.record(q, Model(cobot).tip(q) + SIGMA * rng.standard_normal((120, 3)))
    rows = dataclasses.replace(rows, approach=np.zeros((120, cobot.n), np.int8))
    *_, (_, fitted) = fit_stages(declared_model(cobot), rows)
    beside = fitted.model.tip_frame(fitted.posture).matrix()[:, :3, :3] @ [0.0, 2e-2, 0.0]
    aside = (np.arange(120) % 10 == 0)[:, None]
    for shared in (1.0, rng.choice([-1.0, 1.0], (120, 1))):  # or gross errors of that size
        residual = np.where(aside, shared * beside, fitted.residual)
        weights = np.where(aside[:, 0], 0.0, 1.0)
        off = dataclasses.replace(fitted, residual=residual, weights=weights)
        found = with_left_out(Structure(False, 1.0, (), 0.0, 1.0), off)
        assert ("axes of the tool" in found.sign) == isinstance(shared, float)
