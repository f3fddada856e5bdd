"""The network against central differences, its fitness, its training on known functions."""

from __future__ import annotations

import numpy as np
import pytest

from bench.smooth import smooth_set
from longarm_comp.core.learn.ensemble import back_propagate
from longarm_comp.core.learn.network import (
    NetworkShape,
    forward,
    hidden_alike,
    normal_equations,
    output_jacobian,
    separate,
    sparrow_start,
    squared_error,
    with_ones,
    xavier_start,
)
from longarm_comp.core.learn.sparrow import SparrowSearch

SHAPE = NetworkShape(4, 5, 3)


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(40, 4))
    y = rng.normal(size=(40, 3))
    return x, y, rng.normal(size=SHAPE.size)


def test_jacobian_is_the_central_difference(problem):
    x, _, weights = problem
    x1, step = with_ones(x), 1e-6
    numeric = np.stack(
        [
            (forward(SHAPE, weights + e, x1) - forward(SHAPE, weights - e, x1)) / (2 * step)
            for e in step * np.eye(SHAPE.size)
        ],
        axis=2,
    )
    np.testing.assert_allclose(output_jacobian(SHAPE, weights, x1), numeric, atol=1e-8)


def test_normal_equations_are_those_of_the_explicit_jacobian(problem):
    x, y, weights = problem
    x1, row = with_ones(x), np.random.default_rng(1).uniform(0, 2, 40)
    matrix, gradient, residual = normal_equations(SHAPE, weights, x1, y, row)
    jacobian = output_jacobian(SHAPE, weights, x1)
    weighted = jacobian * row[:, None, None]
    np.testing.assert_allclose(matrix, np.einsum("nki,nkj->ij", weighted, jacobian), atol=1e-10)
    np.testing.assert_allclose(gradient, np.einsum("nki,nk->i", weighted, residual), atol=1e-10)
    np.testing.assert_allclose(residual, y - forward(SHAPE, weights, x1), atol=1e-14)


def test_population_fitness_is_the_mean_squared_error_of_each(problem):
    x, y, _ = problem
    population = np.random.default_rng(2).normal(size=(70, SHAPE.size)) * 3
    one_by_one = [np.mean((forward(SHAPE, w, with_ones(x)) - y) ** 2) for w in population]
    np.testing.assert_allclose(squared_error(SHAPE, x, y)(population), one_by_one, rtol=2e-6)


def test_population_fitness_survives_saturated_units(problem):
    x, y, weights = problem
    huge = np.stack((weights * 1e4, -weights * 1e4))
    assert np.all(np.isfinite(squared_error(SHAPE, x, y)(huge)))


def test_groups_cover_every_weight_once_per_input():
    group = SHAPE.groups()
    assert len(group) == SHAPE.size
    v, w, b = SHAPE.split(group)
    for i in range(5):
        assert set(v[i]) == {i}
    assert set(w.ravel()) == {5} and set(b) == {6}


def test_training_finds_the_noise_and_the_input_that_does_not_matter():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(400, 3))
    truth = np.stack((np.sin(x[:, 0]), x[:, 0] * x[:, 1], np.cos(x[:, 1])), axis=1)
    y = truth + 0.1 * rng.normal(size=truth.shape)
    shape = NetworkShape(3, 10, 3)
    fit = back_propagate(shape, xavier_start(shape, rng), x, y)
    error = forward(shape, fit.weights, with_ones(x)) - truth
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert 0.085 < fit.sigma < 0.115
    assert fit.relevance[2] > 20 * fit.relevance[:2].max()
    assert 10 < fit.effective < shape.size
    np.testing.assert_allclose(fit.row_weights, 1.0, atol=0.2)


def test_gross_outliers_are_weighted_down_and_do_not_spoil_the_fit():
    rng = np.random.default_rng(4)
    x = rng.uniform(-1.5, 1.5, size=(400, 2))
    truth = np.stack((np.sin(x[:, 0]), x[:, 0] * x[:, 1], np.cos(x[:, 1])), axis=1)
    y = truth + 0.05 * rng.normal(size=truth.shape)
    shape, start = NetworkShape(2, 8, 3), xavier_start(NetworkShape(2, 8, 3), rng)
    clean = back_propagate(shape, start, x, y)
    bad = rng.permutation(400)[:12]  # 3 %
    y[bad] += rng.choice([-3.0, 3.0], (12, 3))
    spoiled = back_propagate(shape, start, x, y)

    def rms(fit):
        return np.sqrt(np.mean((forward(shape, fit.weights, with_ones(x)) - truth) ** 2))

    assert spoiled.row_weights[bad].max() < 0.1 < np.delete(spoiled.row_weights, bad).min()
    assert rms(spoiled) < 1.5 * rms(clean)
    assert spoiled.sigma < 1.2 * clean.sigma


def test_sixty_sparrow_starts_have_no_collapsed_units():
    data = smooth_set(300, 0)
    x = (data.q - data.q.mean(0)) / data.q.std(0)
    y = (data.residual - data.residual.mean(0)) / data.residual.std()
    shape, search = NetworkShape(7, 12, 3), SparrowSearch(20, 20)
    fitness = squared_error(shape, x, y)
    for seed in range(60):
        start = sparrow_start(shape, fitness, np.random.default_rng(seed), search)
        assert not hidden_alike(shape, start).any()


def test_a_collapsed_start_is_found_and_separated_without_touching_the_rest():
    rng = np.random.default_rng(6)
    weights = xavier_start(SHAPE, rng)
    v, _, _ = SHAPE.split(weights)
    v[:, 3] = v[:, 1]
    v[:, 4] = -v[:, 1]
    np.testing.assert_array_equal(hidden_alike(SHAPE, weights), [False, False, False, True, True])
    apart = separate(SHAPE, weights, rng)
    assert not hidden_alike(SHAPE, apart).any()
    np.testing.assert_array_equal(SHAPE.split(apart)[0][:, :3], v[:, :3])
    assert hidden_alike(SHAPE, np.ones(SHAPE.size)).sum() == 4
    assert not hidden_alike(SHAPE, separate(SHAPE, np.ones(SHAPE.size), rng)).any()
