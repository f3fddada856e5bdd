"""Benchmark of the sparrow search against mealpy's: fitness evaluations per second."""

from __future__ import annotations

import time

import torch

from bench.comparison import Result, beside
from bench.mealpy_peer import MealpyPeer
from bench.ssa_problem import SHAPE, SsaProblem
from longarm_comp.core.learn.sparrow import SparrowSearch

POPULATION = 50
EPOCHS = 40


def evals_vs_mealpy(samples: int, repeats: int = 7) -> Result:
    """Fitness evaluations/s of a whole sparrow search against mealpy's ``OriginalSSA``.

    Goals: 8 at 300 samples, 6 at 900.
    The same data, network, population and iterations; the two take turns, medians are compared.
    """
    torch.set_num_threads(1)
    problem = SsaProblem.of(samples)
    evaluations = SparrowSearch(POPULATION, EPOCHS).evaluations
    ours: list[float] = []
    theirs: list[float] = []
    with MealpyPeer(*problem.standardised, SHAPE.hidden) as peer:
        peer.solve(POPULATION, 2, 0)  # warm-up of both
        problem.search(POPULATION, EPOCHS, 0)
        for seed in range(repeats):
            begin = time.perf_counter()
            problem.search(POPULATION, EPOCHS, seed)
            ours.append(evaluations / (time.perf_counter() - begin))
            answer = peer.solve(POPULATION, EPOCHS, seed)
            theirs.append(answer["evaluations"] / answer["seconds"])
    return beside(
        "evaluations/s",
        ours,
        "mealpy 3.0.3 OriginalSSA",
        theirs,
        more_is_better=True,
    )
