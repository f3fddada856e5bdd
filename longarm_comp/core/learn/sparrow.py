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

The paper prints other updates. Starving followers move by ``exp((Xworst - X) / (alpha T))``;
followers stay near themselves, for ``Xp`` is printed as ``X``; vigilantes fly from the worst by
``exp(|Xworst - X| / (f - f_worst))``, without bound as ``f`` approaches it, and share one ``beta``.

Known weakness: the update is biased towards the origin and the diagonal (all coordinates alike),
so as a general-purpose optimiser it loses to differential evolution on shifted problems.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from longarm_comp.core.errors import InputError

Fitness = Callable[[Tensor], Tensor]
"""Positions (M, P, D) of M searches -> values (M, P)."""

_PD, _SD, _ST = 0.2, 0.1, 0.8  # those of the reference code


def uniform(rng: torch.Generator, like: Tensor, *size: int) -> Tensor:
    """Return random numbers in [0, 1) of a size, with the type and device of a tensor."""
    return like.new_empty(size).uniform_(generator=rng)


def normal(rng: torch.Generator, like: Tensor, *size: int) -> Tensor:
    """Return normal random numbers, mean 0 and variance 1, in the form that `uniform` has."""
    return like.new_empty(size).normal_(generator=rng)


# The four moves of the algorithm; each returns (M, m, D) positions. ``position`` (M, m, D) are the
# personal bests of those that move, ``rank`` (m,) their ``i``, ``leader`` (M, 1, D) is the best
# discoverer; ``best`` and ``worst`` (M, 1, D+1) of all have their fitness as the last column.


def discover(
    rng: torch.Generator, position: Tensor, rank: Tensor, horizon: int, alarmed: Tensor
) -> Tensor:
    """Move the discoverers: to the origin, or along the diagonal if `alarmed` (M, 1, 1)."""
    alpha = 1.0 - uniform(rng, position, *position.shape[:2])  # (0, 1]
    calm = position * torch.exp(-rank / (alpha * horizon))[..., None]
    return torch.where(alarmed, position + normal(rng, position, *position.shape[:2], 1), calm)


def follow(rng: torch.Generator, position: Tensor, leader: Tensor) -> Tensor:
    sign = torch.where(uniform(rng, position, *position.shape) < 0.5, -1.0, 1.0)
    # ``|X - Xp| A+ L``: the mean of randomly signed distances, the same in every dimension
    return leader + ((position - leader) * sign).mean(dim=2, keepdim=True)


def starve(rng: torch.Generator, position: Tensor, rank: Tensor, worst: Tensor) -> Tensor:
    quantity = normal(rng, position, *position.shape[:2], 1)
    return quantity * torch.exp((worst[..., :-1] - position) / rank[:, None] ** 2)


def watch(rng: torch.Generator, own: Tensor, best: Tensor, worst: Tensor) -> Tensor:
    """Move the vigilantes ``own`` (M, m, D+1), whose fitness is the last column."""
    position, fitness = own[..., :-1], own[..., -1:]
    beta = normal(rng, position, *position.shape)
    towards = best[..., :-1] + beta * (position - best[..., :-1]).abs()
    k = 2.0 * uniform(rng, position, *position.shape[:2], 1) - 1.0
    gap = fitness - worst[..., -1:]
    step = k * (position - worst[..., :-1]).abs()
    away = position + torch.where(gap < 0, step / gap, 0.0)
    return torch.where(fitness > best[..., -1:], towards, away)


@dataclass(frozen=True)
class SparrowSearch:
    population: int = 50
    iterations: int = 100

    def __post_init__(self) -> None:
        for name, least in (("population", 4), ("iterations", 1)):
            if (given := getattr(self, name)) < least:
                raise InputError("sparrow search", name, given, f"an integer >= {least}")

    @property
    def evaluations(self) -> int:
        """The number of evaluations of the fitness in one search."""
        return self.population + self.iterations * (self.population + self._watchers)

    @property
    def _watchers(self) -> int:
        return max(1, round(_SD * self.population))

    def minimise(
        self, fitness: Fitness, lower: Tensor, upper: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Minimise ``fitness`` over the boxes ``lower <= x <= upper``, (M, D) each, at once.

        Args:
            fitness: NaN counts as infinitely bad.
            rng: the only source of randomness; the same state gives the same result.

        Returns: the best positions found (M, D), and their fitness (M,).
        """
        (many, size), n, horizon = lower.shape, self.population, self.iterations
        lead = max(1, round(_PD * n))
        half = max(lead, n // 2)
        rank = torch.arange(1, n + 1, dtype=lower.dtype, device=lower.device)
        low, high = lower[:, None], upper[:, None]
        search = torch.arange(many, device=lower.device)[:, None]

        def land(position: Tensor) -> Tensor:
            """Return positions clipped to the box, with the fitness as last column, (M, m, D+1)."""
            position = position.nan_to_num(nan=torch.inf).clamp(low, high)
            value = fitness(position).to(position.dtype).nan_to_num(nan=torch.inf, posinf=torch.inf)
            return torch.cat((position, value[..., None]), dim=2)

        def best_of(sparrows: Tensor) -> Tensor:
            return sparrows[search, sparrows[..., -1].argmin(dim=1, keepdim=True)]

        def worst_of(sparrows: Tensor) -> Tensor:
            return sparrows[search, sparrows[..., -1].argmax(dim=1, keepdim=True)]

        def better(home: Tensor, now: Tensor) -> Tensor:
            return torch.where(now[..., -1:] < home[..., -1:], now, home)

        home = now = land(low + (high - low) * uniform(rng, lower, many, n, size))  # personal bests
        for _ in range(horizon):
            home = home[search, home[..., -1].argsort(dim=1, stable=True)]
            alarmed, place = uniform(rng, lower, many, 1, 1) >= _ST, home[..., :-1]
            leaders = land(discover(rng, place[:, :lead], rank[:lead], horizon, alarmed))
            followers = follow(rng, place[:, lead:half], best_of(leaders)[..., :-1])
            starving = starve(rng, place[:, half:], rank[half:], worst_of(now))
            now = torch.cat((leaders, land(torch.cat((followers, starving), dim=1))), dim=1)
            home = better(home, now)

            best, worst = best_of(home), worst_of(now)
            order = uniform(rng, lower, many, n).argsort(dim=1)  # the first of them watch
            home, now = home[search, order], now[search, order]
            moved = land(watch(rng, home[:, : self._watchers], best, worst))
            now = torch.cat((moved, now[:, self._watchers :]), dim=1)
            home = better(home, now)
        found = best_of(home)[:, 0]
        return found[:, :-1], found[:, -1]
