"""The most probable values of a normal distribution within bounds."""

import numpy as np
import pytest

from longarm_comp.core.calibration import linear


def test_the_most_probable_values_within_bounds_are_the_constrained_minimum(
    rng: np.random.Generator,
) -> None:
    """Of four correlated values two are below their bound; the free one follows."""
    root = rng.normal(size=(4, 4)) * [[1e-3], [1.0], [1e2], [1.0]]
    covariance, mean = root @ root.T, np.array([-1e-3, 0.5, -50.0, 2.0])
    lower, upper = np.array([0.0, -np.inf, 0.0, -np.inf]), np.array([np.inf, np.inf, 1e3, 1e3])
    found = linear.most_probable_within(mean, covariance, lower, upper)
    slope = np.linalg.solve(covariance, found - mean) * np.sqrt(np.diag(covariance))
    held = found == lower
    assert held.any() and (found >= lower).all() and (slope[held] > 0).all()
    np.testing.assert_allclose(slope[~held], 0, atol=1e-6)
    inside = np.array([1e-3, 0.5, 50.0, 2.0])
    assert linear.most_probable_within(inside, covariance, lower, upper) is inside


def test_columns_that_rounding_leaves_no_inverse_are_solved_all_the_same() -> None:
    rng = np.random.default_rng(1)
    a = 1e9 * rng.standard_normal((40, 6)) @ rng.standard_normal((6, 9))  # three are of the others
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(a.T @ a + np.eye(9))
    y = a @ rng.standard_normal(9)
    found = linear.solve_posterior(a, y)
    assert np.linalg.norm(a @ found.u - y) < 1e-3 * np.linalg.norm(y)
    assert np.isfinite(found.covariance).all() and 0.0 <= found.effective <= 9.0
    assert np.isfinite(linear.Marginal(a, y).evidence)
