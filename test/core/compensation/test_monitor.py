"""The sequential test: its promise on false alarms, and how soon it sees a drift."""

import numpy as np
import pytest

from longarm_comp.core.compensation.drift import Monitor
from longarm_comp.core.errors import InputError

SIGMA = np.array([3e-4, 5e-4, 4e-4])


def samples_to_alarm(monitor: Monitor, residuals: np.ndarray) -> int | None:
    for count, residual in enumerate(residuals, 1):
        monitor = monitor.seen(residual, SIGMA)
        if monitor.verdict().drifted:
            return count
    return None


def test_false_alarms_are_rarer_than_promised(rng: np.random.Generator) -> None:
    """In 40 runs of 200 samples, at one in 200 on average, at most 1 - exp(-1) would alarm."""
    noise = rng.standard_normal((40, 200, 3)) * SIGMA
    alarms = sum(samples_to_alarm(Monitor(run_length=200), run) is not None for run in noise)
    assert alarms <= 0.63 * 40


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_shift_of_two_sigma_is_seen_soon_and_named(
    rng: np.random.Generator, axis: int, sign: int
) -> None:
    residuals = rng.standard_normal((60, 3)) * SIGMA
    residuals[20:, axis] += sign * 2 * SIGMA[axis]
    monitor = Monitor(run_length=1e4)
    for residual in residuals[:20]:
        monitor = monitor.seen(residual, SIGMA)
    assert not monitor.verdict().drifted
    for residual in residuals[20:]:
        monitor = monitor.seen(residual, SIGMA)
    verdict = monitor.verdict()
    assert verdict.drifted
    assert f"in {'xyz'[axis]}" in verdict.finding
    told = float(verdict.finding.split("off by ")[1].split(" mm")[0])
    assert told == pytest.approx(sign * 2e3 * SIGMA[axis], rel=0.3)
    # Wald: about threshold / (information per sample) = 11.2 / 1.5 samples.
    alone = rng.standard_normal((100, 60, 3)) * SIGMA
    alone[:, :, axis] += sign * 2 * SIGMA[axis]
    waits = [samples_to_alarm(Monitor(run_length=1e4), run) for run in alone]
    assert np.mean([60 if wait is None else wait for wait in waits]) < 11


def test_larger_errors_without_a_direction_are_seen(rng: np.random.Generator) -> None:
    residuals = 3.0 * rng.standard_normal((30, 3)) * SIGMA
    residuals[1::2] = -residuals[::2]  # no shift at all
    monitor = Monitor()
    for residual in residuals:
        monitor = monitor.seen(residual, SIGMA)
    verdict = monitor.verdict()
    assert verdict.drifted
    assert "times what the model promised" in verdict.finding


def test_a_single_gross_outlier_after_calm_is_forgotten(rng: np.random.Generator) -> None:
    """Not a threshold on one residual: 3.5 sigma once is no drift."""
    monitor = Monitor(run_length=1e4)
    for _ in range(20):
        monitor = monitor.seen(0.2 * rng.standard_normal(3) * SIGMA, SIGMA)
    monitor = monitor.seen([3.5 * SIGMA[0], 0, 0], SIGMA)
    assert not monitor.verdict().drifted
    for _ in range(20):
        monitor = monitor.seen(0.2 * rng.standard_normal(3) * SIGMA, SIGMA)
    assert monitor.verdict().evidence == 0.0


def test_of_a_residual_whose_axes_depend_on_each_other_the_root_of_its_covariance_is_taken(
    rng: np.random.Generator,
) -> None:
    """The symmetric one, which turns the axes least."""
    root = np.array([[3e-4, 2e-4, 0.0], [2e-4, 5e-4, -1e-4], [0.0, -1e-4, 4e-4]])
    z = 3.0 * rng.standard_normal(3)
    of_covariance = Monitor().seen(root @ z, root @ root)
    np.testing.assert_allclose(of_covariance.sums, Monitor().seen(z, np.ones(3)).sums, atol=1e-9)


@pytest.mark.parametrize(
    ("residual", "sigma"),
    [
        ([0, 0], SIGMA),
        ([np.nan, 0, 0], SIGMA),
        ([0, 0, 0], [0, 1, 1]),
        ([0, 0, 0], [-1, 1, 1]),
        ([0, 0, 0], [1, 1]),
        ([0, 0, 0], np.diag([1.0, 1.0, -1.0])),
        ([0, 0, 0], np.full((3, 3), np.nan)),
    ],
)
def test_what_is_no_sample_is_refused(residual: list[float], sigma: list[float]) -> None:
    with pytest.raises(InputError):
        Monitor().seen(residual, sigma)
