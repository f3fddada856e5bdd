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

    @classmethod
    def of(cls, home: Tensor, now: Tensor, horizon: int) -> Flock:
        """From the personal bests and where the sparrows are now, (M, n, D+1) each."""
        best = _take(home, home[..., -1].argmin(1, keepdim=True))
        worst = _take(now, now[..., -1].argmax(1, keepdim=True))
        return cls(best[..., :-1], worst[..., :-1], best[..., -1], worst[..., -1], horizon)


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
        beta = normal(rng, position, *position.shape)
        towards = flock.best + beta * (position - flock.best).abs()
        k = 2.0 * uniform(rng, position, *position.shape[:2], 1) - 1.0
        gap = (fitness - flock.worst_fitness)[..., None]
        away = position + torch.where(gap < 0, k * (position - flock.worst).abs() / gap, 0.0)
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
        for name, least in (("population", 4), ("iterations", 1)):
            if (given := getattr(self, name)) < least:
                raise InputError("sparrow search", name, given, f"an integer >= {least}")

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

        def land(position: Tensor) -> Tensor:
            """(M, m, D+1): positions within the box, with their fitness as the last column."""
            position = position.nan_to_num(nan=torch.inf).clamp(low, high)
            value = fitness(position).to(position.dtype).nan_to_num(nan=torch.inf, posinf=torch.inf)
            return torch.cat((position, value[..., None]), dim=2)

        home = now = land(low + (high - low) * uniform(rng, lower, many, n, size))  # personal bests
        for _ in range(horizon):
            home = _take(home, home[..., -1].argsort(dim=1, stable=True))
            flock = Flock.of(home, now, horizon)
            alarmed, place = uniform(rng, lower, many, 1, 1) >= _ST, home[..., :-1]
            leaders = land(rules.discover(rng, place[:, :lead], rank[:lead], horizon, alarmed))
            leader = _take(leaders, leaders[..., -1].argmin(1, keepdim=True))[..., :-1]
            followers = rules.follow(rng, place[:, lead:half], leader)
            starving = rules.starve(rng, place[:, half:], rank[half:], flock)
            now = torch.cat((leaders, land(torch.cat((followers, starving), dim=1))), dim=1)
            home = _better(home, now)

            flock = Flock.of(home, now, horizon)
            order = uniform(rng, lower, many, n).argsort(dim=1)  # the first of them watch
            home, now = _take(home, order), _take(now, order)
            own = home[:, :watchers]
            moved = land(rules.watch(rng, own[..., :-1], own[..., -1], flock))
            now = torch.cat((moved, now[:, watchers:]), dim=1)
            home = _better(home, now)
        found = Flock.of(home, now, horizon)
        evaluations = n + horizon * (n + watchers)
        return SparrowResult(found.best[:, 0], found.best_fitness[:, 0], evaluations)


def _take(sparrows: Tensor, index: Tensor) -> Tensor:
    """(M, m, D+1) of sparrows (M, n, D+1) by their numbers (M, m)."""
    return sparrows[torch.arange(len(sparrows), device=index.device)[:, None], index]


def _better(home: Tensor, now: Tensor) -> Tensor:
    return torch.where(now[..., -1:] < home[..., -1:], now, home)
