"""Sparrow search: the moves one by one, the whole search, the errata of the printed form."""

from __future__ import annotations

import pytest
import torch

from bench.sparrow_as_printed import PRINTED, RULES
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.sparrow import CANONICAL, Flock, SparrowSearch, normal, uniform

DOUBLE = {"dtype": torch.float64}


def rng(seed):
    return torch.Generator().manual_seed(seed)


LIKE = torch.zeros(1, **DOUBLE)


def sphere(x):
    return (x**2).sum(2)


def box(low, high, dims, many=1):
    return torch.full((many, dims), low, **DOUBLE), torch.full((many, dims), high, **DOUBLE)


def flock(dims=6, horizon=100, worst_fitness=9.0):
    best = torch.full((1, 1, dims), 0.5, **DOUBLE)
    worst = torch.linspace(-2.0, 2.0, dims, **DOUBLE)[None, None]
    one = torch.ones(1, 1, **DOUBLE)
    return Flock(best, worst, one, worst_fitness * one, horizon)


def range_of(x):
    return x.amax(-1) - x.amin(-1)


def test_calm_discoverers_contract_and_alarmed_ones_step_along_the_diagonal():
    position, rank = normal(rng(0), LIKE, 1, 4, 6), torch.arange(1.0, 5.0, **DOUBLE)
    calm, alarm = torch.tensor([[[False]]]), torch.tensor([[[True]]])
    ratio = CANONICAL.discover(rng(1), position, rank, 100, calm) / position
    assert ((ratio > 0) & (ratio < 1)).all()
    torch.testing.assert_close(ratio, ratio[..., :1].expand_as(ratio))
    step = CANONICAL.discover(rng(1), position, rank, 100, alarm) - position
    torch.testing.assert_close(step, step[..., :1].expand_as(step))


def test_pseudo_inverse_of_the_sign_row_is_its_transpose_over_d():
    signs = torch.where(uniform(rng(3), LIKE, 1, 9) < 0.5, -1.0, 1.0).double()
    torch.testing.assert_close(torch.linalg.pinv(signs), signs.T / 9)


def test_followers_gather_at_the_leader_and_printed_ones_stay_where_they_are():
    position, leader = torch.full((1, 200, 6), 5.0, **DOUBLE), torch.full((1, 1, 6), 4.0, **DOUBLE)
    canonical = CANONICAL.follow(rng(2), position, leader)
    printed = PRINTED.follow(rng(2), position, leader)
    assert ((canonical - leader).abs() <= 1.0 + 1e-12).all()
    assert canonical.mean() == pytest.approx(4.0, abs=0.1)
    assert printed.mean() == pytest.approx(5.0, abs=0.1)
    assert ((canonical - leader).abs().amax() > 0.5) and not range_of(canonical).any()


def test_printed_starving_sparrows_have_nearly_equal_coordinates():
    position = 2.0 * uniform(rng(4), LIKE, 1, 300, 6) - 1.0
    rank = torch.arange(26.0, 326.0, **DOUBLE)
    printed = PRINTED.starve(rng(5), position, rank, flock(horizon=1000))
    assert (range_of(printed) / printed.abs().mean(-1)).median() < 0.05
    early = CANONICAL.starve(rng(5), position[:, :2], torch.ones(2, **DOUBLE), flock())
    assert (range_of(early) / early.abs().mean(-1) > 0.5).all()
    quantity = normal(rng(5), LIKE, 1, 2, 1)
    torch.testing.assert_close(early, quantity * torch.exp(flock().worst - position[:, :2]))


def test_vigilantes_fly_to_the_best_per_dimension_and_equal_worst_stays():
    position, state = normal(rng(6), LIKE, 1, 3, 6), flock()
    fitness = torch.tensor([[4.0, 4.0, 1.0]], **DOUBLE)
    moved = CANONICAL.watch(rng(7), position, fitness, state)
    beta = ((moved - state.best) / (position - state.best).abs())[:, :2]
    assert (range_of(beta) > 0.1).all()
    away = (moved - position)[0, 2] / (position - state.worst).abs()[0, 2]
    torch.testing.assert_close(away, away[:1].expand(6))  # K / (f - f_worst)
    assert 0 < away[0].abs() < 1 / 8
    stays = CANONICAL.watch(rng(7), position, fitness[:, 2:], flock(worst_fitness=1.0))
    torch.testing.assert_close(stays, position)


@pytest.mark.parametrize("form", sorted(RULES))
def test_search_is_deterministic_bounded_monotone_and_counts_its_evaluations(form):
    seen = []

    def fitness(x):
        seen.append(x.clone())
        return sphere(x - 0.3)

    search = SparrowSearch(population=20, iterations=30, rules=RULES[form])
    bounds = box(-1.0, 0.8, 5, 2)
    result = search.minimise(fitness, *bounds, rng(8))
    again = search.minimise(fitness, *bounds, rng(8))
    other = search.minimise(sphere, *bounds, rng(9))
    assert result.position.equal(again.position)
    assert not result.position.equal(other.position)
    points = torch.cat(seen, dim=1)
    assert ((points >= -1.0) & (points <= 0.8)).all()
    assert result.evaluations == again.evaluations == points.shape[1] // 2 == 20 + 30 * 22
    assert result.fitness.equal(sphere(points - 0.3).view(2, -1).amin(1))
    assert result.fitness.equal(sphere(result.position[:, None] - 0.3)[:, 0])


def test_searches_beside_each_other_each_find_their_own():
    centres = torch.tensor([[0.5, -0.4], [-0.6, 0.2]], **DOUBLE)
    search = SparrowSearch(40, 100)
    found = search.minimise(lambda x: sphere(x - centres[:, None]), *box(-1.0, 1.0, 2, 2), rng(3))
    torch.testing.assert_close(found.position, centres, atol=0.1, rtol=0)


def test_search_beats_random_sampling_with_the_same_number_of_evaluations():
    centre = torch.linspace(-0.5, 0.5, 8, **DOUBLE)

    def fitness(x):
        return sphere(x - centre)

    bounds = box(-2.0, 2.0, 8)
    for seed in range(3):
        result = SparrowSearch(30, 60).minimise(fitness, *bounds, rng(seed))
        random = 4.0 * uniform(rng(seed), LIKE, 1, result.evaluations, 8) - 2.0
        assert result.fitness[0] < 0.5 * fitness(random).min()


def test_nan_fitness_counts_as_infinitely_bad():
    centre = torch.tensor([-0.5, 0.5], **DOUBLE)

    def fitness(x):
        return torch.where(x[..., 0] > 0, torch.nan, sphere(x - centre))

    result = SparrowSearch(20, 40).minimise(fitness, *box(-1.0, 1.0, 2), rng(0))
    assert result.position[0, 0] <= 0 and result.fitness.isfinite().all()


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
