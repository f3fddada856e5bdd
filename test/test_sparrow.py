"""Sparrow search: the moves one by one, the whole search, the errata of the printed form."""

from __future__ import annotations

import numpy as np
import pytest

from bench.sparrow_as_printed import PRINTED, RULES
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.sparrow import CANONICAL, Flock, SparrowSearch


def sphere(x):
    return np.sum(x**2, axis=1)


def flock(dims=6, horizon=100):
    return Flock(np.full(dims, 0.5), np.linspace(-2.0, 2.0, dims), 1.0, 9.0, horizon)


def test_calm_discoverers_contract_and_alarmed_ones_step_along_the_diagonal():
    position, rank = np.random.default_rng(0).normal(size=(4, 6)), np.arange(1.0, 5.0)
    calm = CANONICAL.discover(np.random.default_rng(1), position, rank, 100, False)
    ratio = calm / position
    assert np.all(ratio > 0) and np.all(ratio < 1)
    np.testing.assert_allclose(ratio, np.repeat(ratio[:, :1], 6, axis=1))
    alarmed = CANONICAL.discover(np.random.default_rng(1), position, rank, 100, True)
    step = alarmed - position
    np.testing.assert_allclose(step, np.repeat(step[:, :1], 6, axis=1), atol=1e-12)


def test_pseudo_inverse_of_the_sign_row_is_its_transpose_over_d():
    signs = np.where(np.random.default_rng(3).random((1, 9)) < 0.5, -1.0, 1.0)
    np.testing.assert_allclose(np.linalg.pinv(signs), signs.T / 9, atol=1e-14)


def test_followers_gather_at_the_leader_and_printed_ones_stay_where_they_are():
    position, leader = np.full((200, 6), 5.0), np.full(6, 4.0)
    canonical = CANONICAL.follow(np.random.default_rng(2), position, leader)
    printed = PRINTED.follow(np.random.default_rng(2), position, leader)
    assert np.all(np.abs(canonical - leader) <= 1.0 + 1e-12)
    np.testing.assert_allclose(canonical.mean(), 4.0, atol=0.1)
    np.testing.assert_allclose(printed.mean(), 5.0, atol=0.1)


def test_printed_starving_sparrows_have_nearly_equal_coordinates():
    position = np.random.default_rng(4).uniform(-1, 1, (300, 6))
    rank = np.arange(26.0, 326.0)
    printed = PRINTED.starve(np.random.default_rng(5), position, rank, flock(horizon=1000))
    unlike = np.ptp(printed, axis=1) / np.abs(printed).mean(axis=1)
    assert np.median(unlike) < 0.05
    early = CANONICAL.starve(np.random.default_rng(5), position[:2], np.ones(2), flock())
    assert np.all(np.ptp(early, axis=1) / np.abs(early).mean(axis=1) > 0.5)


def test_vigilantes_fly_to_the_best_per_dimension_and_equal_worst_stays():
    position, state = np.random.default_rng(6).normal(size=(3, 6)), flock()
    moved = CANONICAL.watch(np.random.default_rng(7), position, np.array([4.0, 4.0, 1.0]), state)
    beta = (moved - state.best)[:2] / np.abs(position - state.best)[:2]
    assert np.all(np.ptp(beta, axis=1) > 0.1)
    all_alike = Flock(state.best, state.worst, 1.0, 1.0, 100)
    stays = CANONICAL.watch(np.random.default_rng(7), position, np.ones(3), all_alike)
    np.testing.assert_array_equal(stays, position)


@pytest.mark.parametrize("form", sorted(RULES))
def test_search_is_deterministic_bounded_monotone_and_counts_its_evaluations(form):
    seen = []

    def fitness(x):
        seen.append(x.copy())
        return sphere(x - 0.3)

    search = SparrowSearch(population=20, iterations=30, rules=RULES[form])
    lower, upper = np.full(5, -1.0), np.full(5, 0.8)
    result = search.minimise(fitness, lower, upper, np.random.default_rng(8))
    again = search.minimise(fitness, lower, upper, np.random.default_rng(8))
    other = search.minimise(sphere, lower, upper, np.random.default_rng(9))
    np.testing.assert_array_equal(result.position, again.position)
    assert not np.array_equal(result.position, other.position)
    points = np.concatenate(seen)
    assert np.all(points >= -1.0) and np.all(points <= 0.8)
    assert result.evaluations == again.evaluations == len(points) // 2 == 20 + 30 * 22
    assert np.all(np.diff(result.history) <= 0) and result.fitness == result.history[-1]
    assert result.fitness == sphere(result.position[None] - 0.3)[0]


def test_search_beats_random_sampling_with_the_same_number_of_evaluations():
    centre = np.linspace(-0.5, 0.5, 8)

    def fitness(x):
        return sphere(x - centre)

    lower, upper = np.full(8, -2.0), np.full(8, 2.0)
    for seed in range(3):
        result = SparrowSearch(30, 60).minimise(fitness, lower, upper, np.random.default_rng(seed))
        random = np.random.default_rng(seed).uniform(lower, upper, (result.evaluations, 8))
        assert result.fitness < 0.5 * fitness(random).min()


def test_nan_fitness_counts_as_infinitely_bad():
    def fitness(x):
        return np.where(x[:, 0] > 0, np.nan, sphere(x - np.array([-0.5, 0.5])))

    result = SparrowSearch(20, 40).minimise(
        fitness, -np.ones(2), np.ones(2), np.random.default_rng(0)
    )
    assert result.position[0] <= 0 and np.isfinite(result.fitness)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"population": 3}, "population"),
        ({"iterations": 0}, "iterations"),
    ],
)
def test_bad_settings_name_the_field(settings, field):
    with pytest.raises(InputError) as caught:
        SparrowSearch(**settings)
    assert caught.value.field == field


@pytest.mark.parametrize("upper", [np.array([1.0, -1.0]), np.array([1.0, np.inf]), np.ones(3)])
def test_bad_bounds_are_refused(upper):
    with pytest.raises(InputError):
        SparrowSearch().minimise(sphere, -np.ones(2), upper, np.random.default_rng(0))
