"""Cubic paths: derivatives, extremes and slopes, against what they were sampled from."""

import numpy as np
import pytest

from longarm_comp.math.cubic_path import CubicPath, monotone_slopes, smooth_slopes

TIMES = np.cumsum(0.03 + 0.01 * np.sin(np.linspace(0.0, 9.0, 200)))


def test_derivatives_and_peaks_are_those_of_the_path() -> None:
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.5, 2.0, 6))
    path = CubicPath(times, rng.normal(size=(6, 2)), rng.normal(size=(6, 2)))
    np.testing.assert_allclose(path.at(times), path.joints, atol=1e-12)
    np.testing.assert_allclose(path.at(times, 1), path.velocities, atol=1e-12)
    share = np.linspace(0.001, 0.999, 400)
    inside = (times[:-1, None] + np.diff(times)[:, None] * share).ravel()
    step = 1e-6
    for order in (1, 2, 3):
        slope = (path.at(inside + step, order - 1) - path.at(inside - step, order - 1)) / (2 * step)
        np.testing.assert_allclose(path.at(inside, order), slope, atol=1e-4)
    np.testing.assert_allclose(path.at(inside, 3)[::400], path.jerk)
    assert path.peak_velocity() == pytest.approx(np.abs(path.at(inside, 1)).max(axis=0), rel=5e-3)
    most = np.abs(path.at(inside, 2)).max(axis=0)
    assert (path.peak_acceleration() >= most).all()
    assert path.peak_acceleration() == pytest.approx(most, rel=5e-3)
    outside = path.at([times[0] - 1.0, times[-1] + 1.0])
    np.testing.assert_allclose(outside, path.joints[[0, -1]], atol=1e-12)


def test_between_the_times_of_chords_joints_go_straight() -> None:
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.1, 3.0, 8))
    path = CubicPath(times, rng.normal(size=(8, 3)), rng.normal(size=(8, 3)))
    dense = np.linspace(times[0], times[-1], 20_001)
    for off in (1e-3, 0.1):
        at = path.chords(off)
        assert set(times) <= set(at) and (np.diff(at) > 0.0).all()
        straight = np.stack([np.interp(dense, at, q) for q in path.at(at).T], axis=-1)
        assert 0.5 * off < np.abs(straight - path.at(dense)).max() <= off
    for begin, end in ((1.5, 0.0), (0.0, 1.5)):  # bent at one end
        bent = CubicPath(np.arange(2.0), np.arange(2.0)[:, None], np.array([[begin], [end]]))
        assert len(bent.chords(1e-3)) == 1 + np.ceil(np.sqrt(3.0 / 8e-3))
    still = CubicPath(times, np.ones((8, 3)), np.zeros((8, 3)))
    np.testing.assert_array_equal(still.chords(1e-3), times)
    assert CubicPath(times[:1], path.joints[:1], path.velocities[:1]).chords(1e-3) == times[:1]


def test_smooth_slopes_keep_the_jerk_of_what_was_sampled_on_any_grid() -> None:
    joints = np.sin(TIMES)[:, None]
    smooth, monotone = (f(TIMES, joints) for f in (smooth_slopes, monotone_slopes))
    inner = slice(5, -5)
    np.testing.assert_allclose(smooth[inner, 0], np.cos(TIMES)[inner], atol=2e-6)
    middle = 0.5 * (TIMES[1:] + TIMES[:-1])
    jerk = CubicPath(TIMES, joints, smooth).jerk[inner, 0]
    np.testing.assert_allclose(jerk, -np.cos(middle)[inner], atol=0.2)
    turns = CubicPath(TIMES, joints, monotone)
    assert np.abs(turns.jerk[inner, 0] + np.cos(middle)[inner]).max() > 5.0
    low, high = turns.extremes()
    assert low >= joints.min() and high <= joints.max()
    assert not smooth[[0, -1]].any() and not monotone[[0, -1]].any()
