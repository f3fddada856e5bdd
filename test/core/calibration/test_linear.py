"""The linear algebra of the fit: noise that is correlated, bounds, evidence."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from small_arm import ARM as SMALL

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.linear import whiten_rows
from longarm_comp.core.calibration.noise import (
    lag_correlation,
)
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.model.model import Model

SIGMA = 4e-4


def ar1(n: int, rho: float, rng: np.random.Generator) -> np.ndarray:
    """Unit noise, (n, 3), correlated by rho from row to row."""
    e = rng.standard_normal((n, 3))
    for k in range(1, n):
        e[k] = rho * e[k - 1] + math.sqrt(1 - rho * rho) * e[k]
    return e


def test_correlated_noise_is_whitened(rng: np.random.Generator) -> None:
    noise = ar1(4000, 0.8, rng)
    sigma = np.array([1e-4, 2e-4, 3e-4])
    every = np.ones((4000, 3), dtype=bool)
    white = whiten_rows((noise * sigma)[..., None], np.ones(4000), sigma, 0.8, every).reshape(-1, 3)
    assert white.std(axis=0) == pytest.approx(1.0, abs=0.05)
    assert abs((white[1:] * white[:-1]).mean()) < 0.05
    assert lag_correlation(noise, np.ones(4000), every) == pytest.approx(0.8, abs=0.03)
    assert lag_correlation(rng.standard_normal((4000, 3)), np.ones(4000), every) == 0.0


def test_correlated_noise_widens_the_intervals(rng: np.random.Generator) -> None:
    """A marker's place under AR(1) noise: honest with rho, three times too sure without."""
    honest, naive = [], []
    for _ in range(25):
        q = rng.uniform(SMALL.lower, SMALL.upper, (60, SMALL.n))
        xyz = Model(SMALL).tip(q) + SIGMA * ar1(60, 0.8, rng)
        model, session = Model(SMALL, (BasePose(),)), Session.record(q, xyz)
        for rho, into in ((0.8, honest), (0.0, naive)):
            found = fit_model(model, session, sigma=np.full(3, SIGMA), rho=rho)
            g = found.columns[0]
            spread = np.sqrt(np.diag(g @ found.covariance @ g.T))
            into.append(g @ found.model.values / spread)
    assert 0.8 < np.std(honest) < 1.2
    assert np.std(naive) > 1.6


def test_bounded_solution_is_the_constrained_minimum(rng: np.random.Generator) -> None:
    a, y = rng.normal(size=(30, 4)), rng.normal(size=30)
    free = linear.solve_posterior(a, y)
    np.testing.assert_allclose(free.u, np.linalg.solve(a.T @ a + np.eye(4), a.T @ y), atol=1e-12)
    lower = np.full(4, -np.inf)
    lower[np.argmin(free.u)] = 0.0
    held = linear.solve_posterior(a, y, lower, np.full(4, np.inf)).u
    slope = a.T @ (a @ held - y) + held
    k = int(np.argmin(free.u))
    assert held[k] == 0.0
    assert slope[k] > 0
    np.testing.assert_allclose(np.delete(slope, k), 0, atol=1e-10)


def test_evidence_is_that_of_the_gaussian(rng: np.random.Generator) -> None:
    """The log Bayes factor against two multivariate normal densities written out."""
    a, b, y = rng.normal(size=(25, 5)), rng.normal(size=(25, 2)), 2 * rng.normal(size=25)
    products = linear.Marginal(a, y).project_products(b)
    added, evidence = (
        linear.solve_products(*products),
        linear.marginalise_first(*products, np.ones(2))[0],
    )

    def log_density(*blocks: np.ndarray) -> float:
        cover = np.eye(25) + sum(m @ m.T for m in blocks)
        return float(multivariate_normal(np.zeros(25), cover).logpdf(y))

    assert evidence == pytest.approx(log_density(a, b) - log_density(a), abs=1e-9)
    both = linear.solve_posterior(np.concatenate([a, b], axis=1), y)
    np.testing.assert_allclose(added.u, both.u[5:], atol=1e-10)
    np.testing.assert_allclose(added.covariance, both.covariance[5:, 5:], atol=1e-10)
