"""The sparrow search with Eq. (6)-(8) as the paper prints them: four lines differ.

- (7), first: ``exp((Xw - X) / (alpha T))`` for ``exp((Xw - X) / i^2)``. A starving sparrow becomes
  ``Q`` times ones, or overflows.
- (7), second: ``X^{t+1}`` on both sides for ``Xp + ...``. Followers never move to the discoverer.
- (8), first: ``exp(|Xw - X| / (f - fw))`` for ``|X - Xw| / (f - fw)``, without bound as f -> fw.
- (8), second: one ``beta`` for one per dimension. Sparrows move along one line only.
"""

from __future__ import annotations

import torch
from torch import Tensor

from longarm_comp.core.learn.sparrow import Rules, diagonal_step, normal, uniform


class Printed(Rules):
    """Those of the paper; discoverers move as in the reference."""

    def follow(self, rng: torch.Generator, position: Tensor, leader: Tensor) -> Tensor:
        return position + diagonal_step(rng, position, leader)

    def starve(
        self, rng: torch.Generator, position: Tensor, rank: Tensor, worst: Tensor, horizon: int
    ) -> Tensor:
        quantity = normal(rng, position, *position.shape[:2], 1)
        alpha = 1.0 - uniform(rng, position, *position.shape[:2], 1)
        return quantity * torch.exp((worst[..., :-1] - position) / (alpha * horizon))

    def watch(self, rng: torch.Generator, own: Tensor, best: Tensor, worst: Tensor) -> Tensor:
        position, fitness = own[..., :-1], own[..., -1:]
        beta = normal(rng, position, *position.shape[:2], 1)
        k = 2.0 * uniform(rng, position, *position.shape[:2], 1) - 1.0
        towards = best[..., :-1] + beta * (position - best[..., :-1]).abs()
        gap = fitness - worst[..., -1:]
        away = position + k * torch.exp((worst[..., :-1] - position).abs() / (gap + 1e-50))
        return torch.where(fitness > best[..., -1:], towards, away)


RULES = {"canonical": Rules(), "printed": Printed()}
