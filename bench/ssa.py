"""Benchmark of the sparrow search against mealpy's: fitness evaluations per second."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from bench.comparison import Result, beside
from bench.mealpy_peer import MealpyPeer
from bench.smooth import SmoothSet, smooth_set
from longarm_comp.core.learn.network import NetworkShape, squared_error
from longarm_comp.core.learn.sparrow import SparrowSearch

HIDDEN = 12  # D = 135 weights
POPULATION = 50
EPOCHS = 40


def evals_vs_mealpy(samples: int, repeats: int = 7) -> Result:
    """Fitness evaluations/s of a whole sparrow search against mealpy's ``OriginalSSA``.

    Goals: 8 at 300 samples, 6 at 900.
    The same data, network, population and iterations; the two take turns, medians are compared.
    """
    x, y = standardised(smooth_set(samples, 0))
    shape, bound = NetworkShape(7, HIDDEN, 3), np.ones(NetworkShape(7, HIDDEN, 3).size)
    search, fitness = SparrowSearch(POPULATION, EPOCHS), squared_error(shape, x, y)
    ours: list[float] = []
    theirs: list[float] = []
    with MealpyPeer(x, y, HIDDEN) as peer:
        peer.solve(POPULATION, 2, 0)  # warm-up of both
        search.minimise(fitness, -bound, bound, np.random.default_rng(0))
        for seed in range(repeats):
            begin = time.perf_counter()
            found = search.minimise(fitness, -bound, bound, np.random.default_rng(seed))
            ours.append(found.evaluations / (time.perf_counter() - begin))
            answer = peer.solve(POPULATION, EPOCHS, seed)
            theirs.append(answer["evaluations"] / answer["seconds"])
    return beside(
        "evaluations/s",
        ours,
        "mealpy 3.0.3 OriginalSSA",
        theirs,
        more_is_better=True,
    )


def standardised(data: SmoothSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x = (data.q - data.q.mean(axis=0)) / data.q.std(axis=0)
    y = (data.residual - data.residual.mean(axis=0)) / data.residual.std()
    return x, y
