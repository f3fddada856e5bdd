"""Sparrow search (SSA): a population search for the start weights of the BP network.

The algorithm of Xue and Shen, Systems Science & Control Engineering 8 (2020) 22-34, the paper's
references [15] and [16], minimising ``fitness`` over a box. Sorted by fitness, ``i = 1..n``:

===================  ========================  ====================================================
role                 who                       update
===================  ========================  ====================================================
discoverer           ``i <= PD n``             ``X exp(-i / (alpha T))`` while ``R2 < ST``, else
                                               ``X + Q`` (one ``Q ~ N(0, 1)`` for every dimension)
follower             ``PD n < i <= n / 2``     ``Xp + sum_j(+-|X_j - Xp_j|) / D``
starving follower    ``i > n / 2``             ``Q exp((Xworst - X) / i^2)``
vigilante            random ``SD n``           ``Xbest + beta |X - Xbest|``, ``beta`` per dimension;
                                               the best: ``X + K |X - Xworst| / (f - f_worst)``
===================  ========================  ====================================================

``A+ = A'(AA')^-1`` of a row ``A`` of ``+-1`` is ``A' / D`` exactly, so nothing is inverted. The
best and the worst are refreshed after the foragers have moved; each sparrow keeps its personal
best; positions are clipped to the bounds. Many searches run at once, one a network; one iteration
evaluates discoverers, followers and vigilantes of all of them as three batches.

The paper prints other updates: `bench/sparrow_as_printed.py`.

Known weakness: the update is biased towards the origin and the diagonal (all coordinates alike),
so as a general-purpose optimiser it loses to differential evolution on shifted problems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from longarm_comp.core.errors import InputError

Fitness = Callable[[Tensor], Tensor]
"""Positions (M, P, D) of M searches -> values (M, P)."""

_PD, _SD, _ST = 0.2, 0.1, 0.8  # those of the reference code


def uniform(rng: torch.Generator, like: Tensor, *size: int) -> Tensor:
    """Random numbers within [0, 1), of the kind of another tensor."""
    return like.new_empty(size).uniform_(generator=rng)


def normal(rng: torch.Generator, like: Tensor, *size: int) -> Tensor:
    """Random numbers of mean 0 and variance 1, of the kind of another tensor."""
    return like.new_empty(size).normal_(generator=rng)


@dataclass(frozen=True)
class Flock:
    """Inputs of the update rules: best, worst and horizon of the current iteration."""

    best: Tensor  # (M, 1, D)
    worst: Tensor  # (M, 1, D)
    best_fitness: Tensor  # (M, 1)
    worst_fitness: Tensor  # (M, 1)
    horizon: int  # T, iterations in all


class Rules:
    """The four moves of the algorithm; each takes and returns (M, m, D) positions."""

    def discover(
        self, rng: torch.Generator, position: Tensor, rank: Tensor, horizon: int, alarmed: Tensor
    ) -> Tensor:
        """Eq. (6): contract while calm, jump along the diagonal when alarmed (M, 1, 1)."""
        alpha = 1.0 - uniform(rng, position, *position.shape[:2])  # (0, 1]
        calm = position * torch.exp(-rank / (alpha * horizon))[..., None]
        return torch.where(alarmed, position + normal(rng, position, *position.shape[:2], 1), calm)

    def follow(self, rng: torch.Generator, position: Tensor, leader: Tensor) -> Tensor:
        return leader + diagonal_step(rng, position, leader)

    def starve(self, rng: torch.Generator, position: Tensor, rank: Tensor, flock: Flock) -> Tensor:
        quantity = normal(rng, position, *position.shape[:2], 1)
        return quantity * torch.exp((flock.worst - position) / rank[:, None] ** 2)

    def watch(
        self, rng: torch.Generator, position: Tensor, fitness: Tensor, flock: Flock
    ) -> Tensor:
        towards = (
            flock.best + normal(rng, position, *position.shape) * (position - flock.best).abs()
        )
        k = 2.0 * uniform(rng, position, *position.shape[:2], 1) - 1.0
        gap = (fitness - flock.worst_fitness)[..., None]
        step = k * (position - flock.worst).abs()
        away = position + torch.where(gap < 0, step / gap, 0.0)
        return torch.where((fitness > flock.best_fitness)[..., None], towards, away)


def diagonal_step(rng: torch.Generator, position: Tensor, leader: Tensor) -> Tensor:
    """``|X - Xp| A+ L``: the mean of randomly signed distances, the same in every dimension."""
    sign = torch.where(uniform(rng, position, *position.shape) < 0.5, -1.0, 1.0)
    return ((position - leader) * sign).mean(dim=2, keepdim=True)


CANONICAL = Rules()


@dataclass(frozen=True)
class SparrowResult:
    position: Tensor  # (M, D) best positions found
    fitness: Tensor  # (M,)
    evaluations: int  # of each search


@dataclass(frozen=True)
class SparrowSearch:
    population: int = 50
    iterations: int = 100
    rules: Rules = CANONICAL

    def __post_init__(self) -> None:
        where = "sparrow search"
        if self.population < 4:
            raise InputError(where, "population", self.population, "an integer >= 4")
        if self.iterations < 1:
            raise InputError(where, "iterations", self.iterations, "an integer >= 1")

    def minimise(
        self, fitness: Fitness, lower: Tensor, upper: Tensor, rng: torch.Generator
    ) -> SparrowResult:
        """Minimise ``fitness`` over the boxes ``lower <= x <= upper``, (M, D) each, at once.

        Args:
            fitness: NaN counts as infinitely bad.
            rng: the only source of randomness; the same state gives the same result.
        """
        (many, size), n, horizon, rules = lower.shape, self.population, self.iterations, self.rules
        lead = max(1, round(_PD * n))
        half = max(lead, n // 2)
        watchers = max(1, round(_SD * n))
        rank = torch.arange(1, n + 1, dtype=lower.dtype, device=lower.device)
        low, high = lower[:, None], upper[:, None]

        def evaluate(position: Tensor) -> Tensor:
            return fitness(position).to(lower.dtype).nan_to_num(nan=torch.inf, posinf=torch.inf)

        def clip(position: Tensor) -> Tensor:
            return torch.fmax(torch.fmin(position, high), low)  # a NaN goes to a bound

        def rows(of: Tensor, index: Tensor) -> Tensor:
            return of.gather(1, index[..., None].expand(-1, -1, size))

        def flock(home: Tensor, value: Tensor, now: Tensor, now_value: Tensor) -> Flock:
            best, at = value.min(dim=1, keepdim=True)
            worst, worst_at = now_value.max(dim=1, keepdim=True)
            return Flock(rows(home, at), rows(now, worst_at), best, worst, horizon)

        home = low + (high - low) * uniform(rng, lower, many, n, size)  # personal bests
        value = evaluate(home)
        now, now_value = home, value
        for _ in range(horizon):
            value, order = value.sort(dim=1, stable=True)
            home = rows(home, order)
            before = flock(home, value, now, now_value)
            alarmed = uniform(rng, lower, many, 1, 1) >= _ST
            leaders = clip(rules.discover(rng, home[:, :lead], rank[:lead], horizon, alarmed))
            leader_value = evaluate(leaders)
            leader = rows(leaders, leader_value.argmin(dim=1, keepdim=True))
            followers = rules.follow(rng, home[:, lead:half], leader)
            starving = rules.starve(rng, home[:, half:], rank[half:], before)
            rest = clip(torch.cat((followers, starving), dim=1))
            now = torch.cat((leaders, rest), dim=1)
            now_value = torch.cat((leader_value, evaluate(rest)), dim=1)
            better = now_value < value
            home = torch.where(better[..., None], now, home)
            value = torch.where(better, now_value, value)

            watching = uniform(rng, lower, many, n).topk(watchers).indices
            own, own_value = rows(home, watching), value.gather(1, watching)
            after = flock(home, value, now, now_value)
            moved = clip(rules.watch(rng, own, own_value, after))
            moved_value = evaluate(moved)
            at = watching[..., None].expand(-1, -1, size)
            now, now_value = now.scatter(1, at, moved), now_value.scatter(1, watching, moved_value)
            better = moved_value < own_value
            home = home.scatter(1, at, torch.where(better[..., None], moved, own))
            value = value.scatter(1, watching, torch.where(better, moved_value, own_value))
        fitness_found, best = value.min(dim=1, keepdim=True)
        evaluations = n + horizon * (n + watchers)
        return SparrowResult(rows(home, best)[:, 0], fitness_found[:, 0], evaluations)
