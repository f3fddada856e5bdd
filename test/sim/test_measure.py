"""Measured sessions: columns, chance, history."""

from typing import Any

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden import drives, loads
from studies.simulated import SimulatedSession, arrival, measure_session
from studies.true_camera import CameraScale, Noise, TrueCamera


def measured(arm: Arm, rows: int = 60, hidden: Any = (), **options: Any) -> SimulatedSession:
    """A session of random poses."""
    rng = np.random.default_rng(8)
    poses = rng.uniform(arm.lower, arm.upper, (rows, arm.n))
    options = {"approach": "random", **options}
    return measure_session(TrueArm(arm, hidden), TrueCamera.of(arm), poses, rng=rng, **options)


def test_a_session_has_the_circumstances_and_the_sides_that_were_written(twin: Arm) -> None:
    made = measured(twin, 12, lost=0.3, repeats=2, approach="mixed")
    assert list(made.session.columns) == ["t_s", "temperature_c", "payload_kg"]
    assert len(made.session) == 12 + 2 * 2
    written = made.truth["written"]
    blank = np.isnan(written)
    assert blank.any() and set(written[~blank]) == {-1.0, 1.0}
    assert (made.session.approach[~blank] == written[~blank, None]).all()


def test_same_seed_same_session(twin: Arm) -> None:
    one, two = measured(twin, 10, outliers=0.2), measured(twin, 10, outliers=0.2)
    assert one.session.hash == two.session.hash


def test_noise_has_its_size_and_points_along_the_sight(twin: Arm) -> None:
    noise = Noise(sigma_m=1e-4, depth_m=1e-3)
    camera = TrueCamera.of(twin)
    rng = np.random.default_rng(0)
    sight = camera.sight(np.tile([0.9, 0.1, 0.2], (20000, 1)))
    error = noise.draw(sight, rng)
    along = np.sum(error * sight, axis=1)
    assert along.std() == pytest.approx(np.hypot(1e-4, 1e-3), rel=0.03)
    assert (error - along[:, None] * sight).std() == pytest.approx(1e-4 * np.sqrt(2 / 3), rel=0.03)


@pytest.mark.parametrize("noise", [Noise(rho=0.8), Noise(tail_dof=4.0)])
def test_correlated_and_heavy_tailed_noise_keep_the_variance(noise: Noise) -> None:
    error = noise.draw(np.tile([0.0, 1.0, 0.0], (40000, 1)), np.random.default_rng(1))
    assert error[:, 0].std() == pytest.approx(noise.sigma_m, rel=0.05)
    lag = np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]
    assert lag == pytest.approx(noise.rho, abs=0.03)
    spread = np.mean(error[:, 0] ** 4) / np.mean(error[:, 0] ** 2) ** 2
    assert (spread > 4) == (noise.tail_dof is not None)


def test_measured_minus_seen_is_noise_and_outliers_are_flagged(twin: Arm) -> None:
    session = measured(twin, 300, outliers=0.1, lost=0.1)
    error = np.linalg.norm(session.session.xyz - session.truth["seen"], axis=1)
    blank = np.isnan(error)
    gross = session.truth["outlier"]
    assert 10 < blank.sum() < 60
    assert 10 < gross.sum() < 60
    assert np.all(error[~blank & ~gross] < 2e-3)
    assert np.all(error[~blank & gross] > 2e-3)
    rms = np.sqrt(np.mean(error[~blank & ~gross] ** 2))
    assert rms == pytest.approx(np.sqrt(3 * 0.22**2 + 0.28**2) * 1e-3, rel=0.1)


def test_repeats_are_the_same_pose_under_the_id_of_the_first(twin: Arm) -> None:
    session = measured(twin, 30, repeats=4).session
    ids, q = session.repeat_id, session.q
    named = np.unique(ids[ids >= 0])
    assert len(named) == 4
    for first in named:
        same = np.flatnonzero(ids == first)
        assert len(same) == 3
        assert same[0] == first
        assert np.ptp(q[same], axis=0).max() == 0.0


def test_both_sides_measures_every_pose_twice(twin: Arm) -> None:
    session = measured(twin, 9, approach="both")
    side = session.truth["written"].reshape(9, 2)
    assert np.array_equal(side.sum(axis=1), np.zeros(9))
    assert np.array_equal(session.session.q[::2], session.session.q[1::2])


def test_a_blank_side_comes_from_the_row_before() -> None:
    q = np.array([[0.0, 0.0], [1.0, -1.0], [1.0, 0.0], [0.5, 0.5]])
    side = arrival(q, np.array([np.nan, np.nan, np.nan, -1.0]))
    assert np.array_equal(side, [[0, 0], [1, -1], [1, 1], [-1, -1]])


def test_history_reaches_the_arm(twin: Arm) -> None:
    """What is measured is the arm in the session's own circumstances."""
    hidden = [drives.FrictionHysteresis(np.full(twin.n, 2e-3)), loads.Creep(0.2, 300.0)]
    session = measured(twin, 20, hidden, approach="previous", payload_kg=0.1)
    assert np.all(np.isnan(session.truth["written"]))
    q, c = session.session.q, session.session.columns
    context = TrueContext(session.truth["side"], c["temperature_c"], 0.1, c["t_s"])
    assert np.allclose(TrueArm(twin, hidden).tip(q, context), session.truth["tip"], atol=1e-12)
    assert not np.allclose(TrueArm(twin).tip(q, context), session.truth["tip"], atol=1e-4)


def test_inclinometer_columns_come_with_the_tilt(twin: Arm) -> None:
    tilt = loads.MeasuredTilt(0, np.array([2e-3, 1e-3]), 2000.0, np.array([0.0, 1e-3]))
    session = measured(twin, 10, [tilt]).session
    assert np.abs(session.columns["incl_0_x"]).max() > 1e-4
    assert "incl_0_y" in session.columns


def test_camera_sees_truth_without_effects_and_scales_about_itself(twin: Arm) -> None:
    points = np.array([[0.9, 0.1, 0.2], [0.7, -0.3, 0.4]])
    assert np.allclose(TrueCamera.of(twin).seen(points), points, atol=1e-15)
    head = TrueCamera.of(twin, [CameraScale(0.01)])
    assert np.allclose(head.seen(points) - points, 0.01 * (points - head.position_m))
    blind = twin.model_copy(update={"camera": None})
    with pytest.raises(InputError, match="camera"):
        TrueCamera.of(blind)
