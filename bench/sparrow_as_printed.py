"""The sparrow search with Eq. (6)-(8) as the paper prints them: four lines differ.

- (7), first: ``exp((Xw - X) / (alpha T))`` for ``exp((Xw - X) / i^2)``. A starving sparrow becomes
  ``Q`` times ones, or overflows.
- (7), second: ``X^{t+1}`` on both sides for ``Xp + ...``. Followers never move to the discoverer.
- (8), first: ``exp(|Xw - X| / (f - fw))`` for ``|X - Xw| / (f - fw)``, without bound as f -> fw.
- (8), second: one ``beta`` for one per dimension. Sparrows move along one line only.
"""

from __future__ import annotations

import numpy as np

from longarm_comp.core.learn.sparrow import CANONICAL, Array, Flock, Rules, diagonal_step


class Printed(Rules):
    """Those of the paper; discoverers move as in the reference."""

    def follow(self, rng: np.random.Generator, position: Array, leader: Array) -> Array:
        return position + diagonal_step(rng, position, leader)

    def starve(self, rng: np.random.Generator, position: Array, rank: Array, flock: Flock) -> Array:
        quantity = rng.standard_normal((len(position), 1))
        alpha = 1.0 - rng.random((len(position), 1))
        moved: Array = quantity * np.exp((flock.worst - position) / (alpha * flock.horizon))
        return moved

    def watch(
        self, rng: np.random.Generator, position: Array, fitness: Array, flock: Flock
    ) -> Array:
        beta = rng.standard_normal((len(position), 1))
        k = rng.uniform(-1.0, 1.0, (len(position), 1))
        towards = flock.best + beta * np.abs(position - flock.best)
        gap = (fitness - flock.worst_fitness)[:, None]
        away = position + k * np.exp(np.abs(flock.worst - position) / (gap + 1e-50))
        moved: Array = np.where((fitness > flock.best_fitness)[:, None], towards, away)
        return moved


PRINTED = Printed()
RULES = {"canonical": CANONICAL, "printed": PRINTED}
