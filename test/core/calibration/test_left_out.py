"""The errors at rows that are left out of a fit, and how wide a promise they ask for."""

import dataclasses

import numpy as np
import pytest
from hidden_arm import SIGMA, at, calibrated, session
from scipy.signal import lfilter
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.left_out import LeftOut, subtract_point_means
from longarm_comp.core.calibration.uncertainty import measure_uncertainty, with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import EITHER, chance_of_arm
from longarm_comp.core.model.uncertainty import sizes
from longarm_comp.sim.hidden.drives import JointGain
from longarm_comp.sim.hidden.geometry import JointZero
from studies import coverage

ZEROS = JointZero(at(1, 0.003) + at(2, -0.004))
LACKING = JointGain(at(2, 0.03))


def left_out(error: np.ndarray, covariance: np.ndarray, amid: np.ndarray, **more) -> LeftOut:
    """Rows that count once each, all of them believed."""
    count, believed = np.ones(len(error)), np.ones(len(error), dtype=bool)
    return LeftOut(
        error, covariance, **{"count": count, "amid": amid, "believed": believed, **more}
    )


def test_rows_left_out_are_missed_as_by_a_fit_without_them() -> None:
    start = calibrated(session([ZEROS, LACKING], n=80))
    settings = {"sigma": np.full(3, 5e-4), "robust": False, "close": 1e-6}
    whole = fit_model(start.model, start.session, **settings)
    rows, weights = whole.session, whole.weights
    left = LeftOut.of(whole)
    assert left is not None
    order = np.argsort(np.argsort(rows.q[weights > 0, 0], kind="stable"))
    out = np.flatnonzero(weights > 0)[order * 4 // len(order) == 0]
    kept = np.setdiff1d(np.arange(len(rows)), out)
    again = fit_model(whole.model, rows.take(kept), **settings)
    held = rows.take(out)
    missed = held.xyz - again.model.tip(held.q, held.context())
    found = left.error[: len(out)]
    assert np.linalg.norm(missed, axis=1).mean() > 1.1 * np.abs(whole.residual[out]).mean()
    np.testing.assert_allclose(found, missed, atol=0.03 * np.abs(missed).max())


def test_errors_of_models_chosen_without_the_row_replace_those_amid_the_rows() -> None:
    fit = calibrated(session([ZEROS], n=80))
    anew = 3.0 * fit.residual
    anew[::4] = np.nan
    plain, chosen = LeftOut.of(fit), LeftOut.of(fit, anew)
    assert plain is not None and chosen is not None
    same = (plain.error == chosen.error).all(axis=1)
    assert same[~plain.amid].all() and same[plain.amid].sum() == np.isnan(anew[:, 0]).sum()
    assert {*chosen.error[~same].ravel()} == {*anew[~np.isnan(anew)]}
    wide, usual = (measure_uncertainty(fit, each) for each in (anew, None))
    assert sizes(wide.structure)[1] > 1.5 * sizes(usual.structure + usual.noise)[1]


def test_the_radius_is_as_wide_as_the_rows_left_out_ask_for() -> None:
    rng = np.random.default_rng(2)
    unit = np.tile(np.eye(3), (400, 1, 1))
    error = 1e-3 * rng.standard_normal((400, 3))
    error[:20] *= 30.0
    small = left_out(error, 1e-9 * unit, np.ones(400, dtype=bool))
    noise = 1e-9 * np.eye(3)
    alike, structure = small.find_least_errors(noise)
    radius = sizes(small.covariance + structure + noise)[1]
    assert alike == 1.0
    assert 0.9 <= np.mean(np.linalg.norm(error, axis=1) <= radius) <= 0.91


@pytest.mark.parametrize("rows", [14, 18])
def test_a_short_session_promises_what_its_commands_miss_too(rows: int) -> None:
    """Joint 2 goes 10 % too far, which the calibration does not fit."""
    hidden, inside = [ZEROS, JointGain(at(2, 0.1))], []
    for seed in range(6):
        short = calibrated(session(hidden, n=rows, seed=seed))
        judged = coverage.judge("", short, session(hidden, seed=100), commanded=True)
        inside.append((judged.error <= judged.radius).mean())
    assert np.mean(inside) > 0.9


def slow(rng: np.random.Generator, n: int) -> np.ndarray:
    """Noise of a tracker that wanders: neighbours in time have nine tenths of it in common."""
    return lfilter(
        [np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], SIGMA * rng.standard_normal((n, 3)), axis=0
    )


def test_a_tracker_that_wanders_promises_less() -> None:
    """Its 120 rows tell as much as six; targets are judged by the true tip."""
    inside = []
    for seed in range(5):
        wandering = calibrated(session([ZEROS], noise=slow, seed=seed))
        exact = session([ZEROS], seed=100, noise=lambda _, n: np.zeros((n, 3)))
        judged = coverage.judge("", wandering, exact, exact.xyz)
        inside.append((judged.error <= judged.radius).mean())
    assert np.mean(inside) > 0.85


@pytest.mark.parametrize(("far", "one"), [(1.0, True), (30.0, False)])
def test_an_error_where_rows_are_far_is_no_error_everywhere(far: float, one: bool) -> None:
    """Rows amid the others contradict it; it grows with what the parameters leave open."""
    rng = np.random.default_rng(3)
    amid = np.arange(400) % 2 == 0
    sd = np.where(amid, 1e-4, 1e-4 * far)
    covariance = sd[:, None, None] ** 2 * np.eye(3)
    error = 5.0 * sd[:, None] * rng.standard_normal((400, 3))
    left = left_out(error, covariance, amid)
    alike, structure = left.find_least_errors(1e-10 * np.eye(3))
    inside = np.linalg.norm(error, axis=1) <= sizes(alike * covariance + structure)[1]
    assert (alike == 1.0) is one
    assert 0.9 <= inside.mean() < 0.95
    assert inside[amid].mean() < 0.97


def test_touched_points_are_judged_about_their_mean(rng: np.random.Generator) -> None:
    names = np.array(["a", "a", "b", "a", "c", "b"])
    rows = rng.standard_normal((6, 3))
    off, alone = subtract_point_means(rows, names)
    assert alone.tolist() == [False, False, False, False, True, False]
    np.testing.assert_allclose(off[[2, 5]].sum(axis=0), 0.0, atol=1e-12)
    drawn = subtract_point_means(rng.standard_normal((20000, 3)), np.repeat(np.arange(10000), 2))[0]
    assert drawn.var() == pytest.approx(1.0, abs=0.03)


def test_errors_that_nothing_explains_are_at_worst_those_amid() -> None:
    """Rows far off that no parameter moves: all rows count as one, and err as the worst amid."""
    error = np.full((40, 3), 1e-4)
    error[20:] = 1.0
    left = left_out(error, np.zeros((40, 3, 3)), np.arange(40) < 20)
    alike, structure = left.find_least_errors(1e-10 * np.eye(3))
    assert alike > 40.0
    assert np.trace(structure) == pytest.approx(3e-8)


@pytest.mark.parametrize(("chance", "radius"), [(0.0, 1.0), (0.5, 1.17), (1.0, 4.0)])
def test_rows_set_aside_count_as_far_as_the_arm_may_have_been_there(
    chance: float, radius: float
) -> None:
    """An eighth of the rows lies ten times as far off: with all of them 90 % need these too."""
    rng = np.random.default_rng(4)
    error = 1e-4 * rng.standard_normal((480, 3))
    aside = np.arange(480) % 8 == 0
    error[aside] *= 10.0
    few = {"count": np.where(aside, chance, 1.0), "believed": ~aside}
    left = left_out(error, np.zeros((480, 3, 3)), ~aside, **few)
    alone = left_out(error[~aside], np.zeros((420, 3, 3)), np.ones(420, dtype=bool))
    wide, usual = (each.find_least_errors(1e-14 * np.eye(3))[1] for each in (left, alone))
    found = sizes(wide)[1] / sizes(usual)[1]
    np.testing.assert_allclose(wide / np.trace(wide), usual / np.trace(usual))  # of the others
    assert found == pytest.approx(radius, rel=0.05)
    inside = np.linalg.norm(error, axis=1) <= sizes(wide)[1]
    assert np.average(inside, weights=few["count"]) >= 0.9


def test_an_arm_that_rests_on_another_seat_now_and_then_promises_less() -> None:
    """A tenth of its rows lie 4 mm off; the fit sets them aside, the commands do not."""
    rows, far = session([ZEROS], n=200), np.arange(200) % 10 == 3
    moved = np.where(far[:, None], [0.0, 4e-3, 0.0], 0.0)
    fit = calibrated(dataclasses.replace(rows, xyz=rows.xyz + moved))
    assert (fit.weights[far] == 0).all()
    known = measure_uncertainty(fit)
    q = session([ZEROS], seed=7).q
    radius = expected_miss(
        dataclasses.replace(fit.model, uncertainty=known), q, Context(), fit.model.tip(q)
    ).sizes[1]
    usual = with_uncertainty(calibrated(rows.take(~far)))
    plain = expected_miss(usual, q, Context(), usual.tip(q)).sizes[1]
    assert 1.5 < np.median(radius) / np.median(plain) < 3.0


def test_a_row_whose_visit_is_believed_was_the_sensor_s() -> None:
    q = np.repeat(np.random.default_rng(2).random((30, ARM.n)), 2, axis=0)
    rows = Session.record(ARM.lower + q * (ARM.upper - ARM.lower), np.zeros((60, 3)))
    aside = np.zeros(60, dtype=bool)
    aside[[4, 20, 21]] = True  # one of a visit, all of another
    chance = chance_of_arm(rows, aside)
    assert chance[[4, 20, 21]].tolist() == [0.0, EITHER, EITHER]
    aside = np.zeros(60, dtype=bool)
    aside[20:36] = True  # eight visits, one after the other
    assert chance_of_arm(rows, aside)[aside].tolist() == [1.0] * 16
