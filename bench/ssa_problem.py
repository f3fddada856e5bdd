"""The smooth benchmark in standardised units, as torch holds it: one network of 12 hidden units."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from bench.smooth import SmoothSet, rms_mm, smooth_set
from longarm_comp.core.learn.network import NetworkShape, TanhMembers
from longarm_comp.core.learn.sparrow import SparrowSearch
from longarm_comp.core.learn.stack import TanhStack
from longarm_comp.core.learn.training import Fits, back_propagate

SHAPE = NetworkShape(7, 12, 3)  # D = 135 weights


@dataclass(frozen=True)
class SsaProblem:
    """Training rows of one network, on a device, and the truth at test poses."""

    data: SmoothSet
    device: str = "cpu"

    @classmethod
    def of(cls, samples: int, seed: int = 0, device: str = "cpu", test: int = 1000) -> SsaProblem:
        return cls(smooth_set(samples, seed, test), device)

    @property
    def standardised(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Inputs (N, 7) and residuals (N, 3)."""
        q, residual = self.data.q, self.data.residual
        x = (q - q.mean(axis=0)) / q.std(axis=0)
        return x, (residual - residual.mean(axis=0)) / residual.std()

    @cached_property
    def stack(self) -> TanhStack:
        return TanhStack(SHAPE, torch.device(self.device))

    @cached_property
    def rows(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Inputs (1, N, 7), residuals (1, N, 3), and ones (1, N): all are used."""
        x, y = (torch.tensor(each[None], device=self.device) for each in self.standardised)
        return x, y, torch.ones_like(x[..., 0])

    def search(
        self, population: int, iterations: int, seed: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Run the raw search, without the guard against collapsed units."""
        bound = torch.ones(1, SHAPE.size, device=self.device)
        search = SparrowSearch(population, iterations)
        fitness = self.stack.squared_error(*self.rows)
        return search.minimise(fitness, -bound, bound, self.chance(seed))

    def start(self, init: str, seed: int) -> torch.Tensor:
        """Initial weights (1, D), by a search of 50 sparrows and 50 iterations or Xavier's."""
        chance, fitness = self.chance(seed), self.stack.squared_error(*self.rows)
        if init == "xavier":
            return self.stack.xavier_starts(1, chance)
        return self.stack.sparrow_starts(fitness, 1, chance, SparrowSearch(50, 50))

    def fit(self, start: torch.Tensor, max_steps: int = 150) -> Fits:
        return back_propagate(self.stack, start.double(), *self.rows, max_steps=max_steps)

    def chance(self, seed: int) -> torch.Generator:
        return torch.Generator(self.device).manual_seed(seed)

    def rms_mm(self, weights: torch.Tensor) -> float:
        """Held-out RMSE per axis of a network (1, D) against the noise-free truth."""
        data = self.data
        x = (data.test_q - data.q.mean(axis=0)) / data.q.std(axis=0)
        found = TanhMembers(SHAPE, weights.double().numpy()).outputs(x)[0]
        error = found * data.residual.std() + data.residual.mean(axis=0) - data.test_truth
        return rms_mm(error)
