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
best; positions are clipped to the bounds. One iteration evaluates discoverers, followers and
vigilantes as three batches.

The paper prints other updates: `bench/sparrow_as_printed.py`.

Known weakness: the update is biased towards the origin and the diagonal (all coordinates alike),
so as a general-purpose optimiser it loses to differential evolution on shifted problems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.errors import InputError

Array = NDArray[np.float64]
Fitness = Callable[[Array], NDArray[np.floating]]

_PD, _SD, _ST = 0.2, 0.1, 0.8  # those of the reference code


@dataclass(frozen=True)
class Flock:
    """Inputs of the update rules: best, worst and horizon of the current iteration."""

    best: Array  # (D,)
    worst: Array  # (D,)
    best_fitness: float
    worst_fitness: float
    horizon: int  # T, iterations in all


def diagonal_step(rng: np.random.Generator, position: Array, leader: Array) -> Array:
    """``|X - Xp| A+ L``: the mean of randomly signed distances, the same in every dimension."""
    sign = 1.0 - 2.0 * rng.integers(0, 2, position.shape, dtype=np.int8)
    return np.mean(np.abs(position - leader) * sign, axis=1, keepdims=True)


class Rules:
    """The four moves of the algorithm; each takes and returns (m, D) positions."""

    def discover(
        self, rng: np.random.Generator, position: Array, rank: Array, horizon: int, alarmed: bool
    ) -> Array:
        """Eq. (6): contract while calm, jump along the diagonal when alarmed."""
        if alarmed:
            return position + rng.standard_normal((len(position), 1))
        alpha = 1.0 - rng.random(len(position))  # (0, 1]
        return position * np.exp(-rank / (alpha * horizon))[:, None]

    def follow(self, rng: np.random.Generator, position: Array, leader: Array) -> Array:
        return leader + diagonal_step(rng, position, leader)

    def starve(self, rng: np.random.Generator, position: Array, rank: Array, flock: Flock) -> Array:
        quantity = rng.standard_normal((len(position), 1))
        return quantity * np.exp((flock.worst - position) / rank[:, None] ** 2)

    def watch(
        self, rng: np.random.Generator, position: Array, fitness: Array, flock: Flock
    ) -> Array:
        beta = rng.standard_normal(position.shape)
        k = rng.uniform(-1.0, 1.0, (len(position), 1))
        towards = flock.best + beta * np.abs(position - flock.best)
        gap = (fitness - flock.worst_fitness)[:, None]
        step = k * np.abs(position - flock.worst)
        away = position + np.divide(step, gap, out=np.zeros_like(step), where=gap < 0)
        return np.where((fitness > flock.best_fitness)[:, None], towards, away)


CANONICAL = Rules()


@dataclass(frozen=True)
class SparrowResult:
    position: Array  # (D,) best position found
    fitness: float
    history: Array  # (T + 1,) best fitness after each iteration, the start first
    evaluations: int


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
        self, fitness: Fitness, lower: Array, upper: Array, rng: np.random.Generator
    ) -> SparrowResult:
        """Minimise ``fitness`` over the box ``lower <= x <= upper``, (D,) each.

        Args:
            fitness: maps positions (P, D) to values (P,) in one call; NaN counts as infinitely bad.
            rng: the only source of randomness; the same state gives the same result.

        Raises:
            InputError: no box.
        """
        fits = lower.ndim == 1 and lower.shape == upper.shape
        if not fits or not (np.isfinite(upper - lower) & (lower < upper)).all():
            allowed = "(D,) finite with lower < upper"
            raise InputError("sparrow search", "bounds", (lower, upper), allowed)
        rules = self.rules
        n, horizon = self.population, self.iterations
        lead = max(1, round(_PD * n))
        half = max(lead, n // 2)
        watchers = max(1, round(_SD * n))
        rank = np.arange(1, n + 1, dtype=float)

        def evaluate(position: Array) -> Array:
            value = np.asarray(fitness(position), float)
            return np.where(np.isnan(value), np.inf, value)

        def clip(position: Array) -> Array:
            return np.fmax(np.fmin(position, upper), lower)  # a NaN goes to a bound

        home = rng.uniform(lower, upper, (n, len(lower)))  # personal bests
        value = evaluate(home)
        history = np.empty(horizon + 1)
        history[0] = value.min()
        now, now_value = home.copy(), value.copy()
        for t in range(1, horizon + 1):
            order = np.argsort(value, kind="stable")
            home, value = home[order], value[order]
            worst = now[np.argmax(now_value)]
            flock = Flock(home[0], worst, value[0], float(now_value.max()), horizon)
            alarmed = bool(rng.random() >= _ST)
            with np.errstate(over="ignore", invalid="ignore"):
                leaders = clip(rules.discover(rng, home[:lead], rank[:lead], horizon, alarmed))
                leader_value = evaluate(leaders)
                leader = leaders[np.argmin(leader_value)]
                followers = rules.follow(rng, home[lead:half], leader)
                starving = rules.starve(rng, home[half:], rank[half:], flock)
                rest = clip(np.concatenate((followers, starving)))
                now = np.concatenate((leaders, rest))
                now_value = np.concatenate((leader_value, evaluate(rest)))
                better = now_value < value
                home[better], value[better] = now[better], now_value[better]

                watching = rng.permutation(n)[:watchers]
                best, worst_index = int(np.argmin(value)), int(np.argmax(now_value))
                f_best, f_worst = float(value[best]), float(now_value[worst_index])
                flock = Flock(home[best], now[worst_index], f_best, f_worst, horizon)
                moved = clip(rules.watch(rng, home[watching], value[watching], flock))
                now[watching] = moved
                now_value[watching] = evaluate(moved)
                better = now_value < value
                home[better], value[better] = now[better], now_value[better]
            history[t] = value.min()
        best = int(np.argmin(value))
        evaluations = n + horizon * (n + watchers)
        return SparrowResult(home[best].copy(), float(value[best]), history, evaluations)
