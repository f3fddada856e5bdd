"""Sparrow search: the moves one by one, and the whole search."""

import pytest
import torch

from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.sparrow import (
    SparrowSearch,
    discover,
    follow,
    normal,
    starve,
    uniform,
    watch,
)

DOUBLE = {"dtype": torch.float64}


def rng(seed):
    return torch.Generator().manual_seed(seed)


LIKE = torch.zeros(1, **DOUBLE)


def sphere(x):
    return (x**2).sum(2)


def box(low, high, dims, many=1):
    return torch.full((many, dims), low, **DOUBLE), torch.full((many, dims), high, **DOUBLE)


BEST = torch.tensor([[[0.5] * 6 + [1.0]]], **DOUBLE)
WORST = torch.cat((torch.linspace(-2.0, 2.0, 6, **DOUBLE), torch.tensor([9.0], **DOUBLE)))[
    None, None
]


def range_of(x):
    return x.amax(-1) - x.amin(-1)


def test_calm_discoverers_contract_and_alarmed_ones_step_along_the_diagonal():
    position, rank = normal(rng(0), LIKE, 1, 4, 6), torch.arange(1.0, 5.0, **DOUBLE)
    calm, alarm = torch.tensor([[[False]]]), torch.tensor([[[True]]])
    ratio = discover(rng(1), position, rank, 100, calm) / position
    assert ((ratio > 0) & (ratio < 1)).all()
    torch.testing.assert_close(ratio, ratio[..., :1].expand_as(ratio))
    step = discover(rng(1), position, rank, 100, alarm) - position
    torch.testing.assert_close(step, step[..., :1].expand_as(step))


def test_pseudo_inverse_of_the_sign_row_is_its_transpose_over_d():
    signs = torch.where(uniform(rng(3), LIKE, 1, 9) < 0.5, -1.0, 1.0).double()
    torch.testing.assert_close(torch.linalg.pinv(signs), signs.T / 9)


def test_followers_gather_at_the_leader():
    position, leader = torch.full((1, 200, 6), 5.0, **DOUBLE), torch.full((1, 1, 6), 4.0, **DOUBLE)
    canonical = follow(rng(2), position, leader)
    assert ((canonical - leader).abs() <= 1.0 + 1e-12).all()
    assert canonical.mean() == pytest.approx(4.0, abs=0.1)
    assert ((canonical - leader).abs().amax() > 0.5) and not range_of(canonical).any()


def test_starving_sparrows_fly_from_the_worst_per_dimension():
    position = 2.0 * uniform(rng(4), LIKE, 1, 2, 6) - 1.0
    early = starve(rng(5), position, torch.ones(2, **DOUBLE), WORST)
    assert (range_of(early) / early.abs().mean(-1) > 0.5).all()
    quantity = normal(rng(5), LIKE, 1, 2, 1)
    torch.testing.assert_close(early, quantity * torch.exp(WORST[..., :-1] - position))


def test_vigilantes_fly_to_the_best_per_dimension_and_equal_worst_stays():
    position = normal(rng(6), LIKE, 1, 3, 6)
    own = torch.cat((position, torch.tensor([[[4.0], [4.0], [1.0]]], **DOUBLE)), dim=2)
    moved = watch(rng(7), own, BEST, WORST)
    beta = ((moved - 0.5) / (position - 0.5).abs())[:, :2]
    assert (range_of(beta) > 0.1).all()
    away = (moved - position)[0, 2] / (position - WORST[..., :-1]).abs()[0, 2]
    torch.testing.assert_close(away, away[:1].expand(6))  # K / (f - f_worst)
    assert 0 < away[0].abs() < 1 / 8
    equal = torch.cat((WORST[..., :-1], BEST[..., -1:]), dim=2)
    torch.testing.assert_close(watch(rng(7), own[:, 2:], BEST, equal), position[:, 2:])


def test_search_is_deterministic_bounded_monotone_and_counts_its_evaluations():
    seen = []

    def fitness(x):
        seen.append(x.clone())
        return sphere(x - 0.3)

    search = SparrowSearch(population=20, iterations=30)
    bounds = box(-1.0, 0.8, 5, 2)
    position, value = search.minimise(fitness, *bounds, rng(8))
    points = torch.cat(seen, dim=1)
    assert position.equal(search.minimise(fitness, *bounds, rng(8))[0])
    assert not position.equal(search.minimise(sphere, *bounds, rng(9))[0])
    assert ((points >= -1.0) & (points <= 0.8)).all()
    assert search.evaluations == points.shape[1] == 20 + 30 * 22
    assert value.equal(sphere(points - 0.3).view(2, -1).amin(1))
    assert value.equal(sphere(position[:, None] - 0.3)[:, 0])


def test_searches_beside_each_other_each_find_their_own():
    centres = torch.tensor([[0.5, -0.4], [-0.6, 0.2]], **DOUBLE)
    search = SparrowSearch(40, 100)
    found, _ = search.minimise(
        lambda x: sphere(x - centres[:, None]), *box(-1.0, 1.0, 2, 2), rng(3)
    )
    torch.testing.assert_close(found, centres, atol=0.1, rtol=0)


def test_search_beats_random_sampling_with_the_same_number_of_evaluations():
    centre = torch.linspace(-0.5, 0.5, 8, **DOUBLE)

    def fitness(x):
        return sphere(x - centre)

    bounds = box(-2.0, 2.0, 8)
    for seed in range(3):
        search = SparrowSearch(30, 60)
        _, found = search.minimise(fitness, *bounds, rng(seed))
        random = 4.0 * uniform(rng(seed), LIKE, 1, search.evaluations, 8) - 2.0
        assert found[0] < 0.5 * fitness(random).min()


def test_nan_fitness_counts_as_infinitely_bad():
    centre = torch.tensor([-0.5, 0.5], **DOUBLE)

    def fitness(x):
        return torch.where(x[..., 0] > 0, torch.nan, sphere(x - centre))

    position, value = SparrowSearch(20, 40).minimise(fitness, *box(-1.0, 1.0, 2), rng(0))
    assert position[0, 0] <= 0 and value.isfinite().all()


@pytest.mark.parametrize(
    ("settings", "field"), [({"population": 3}, "population"), ({"iterations": 0}, "iterations")]
)
def test_bad_settings_name_the_field(settings, field):
    with pytest.raises(InputError) as caught:
        SparrowSearch(**settings)
    assert caught.value.field == field
