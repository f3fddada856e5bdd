"""SSA-BP against samples and population: rates, seconds and memory, each in its own process."""

from __future__ import annotations

import time

import numpy as np

from bench.comparison import Result, beside, missing
from bench.mealpy_peer import MealpyPeer
from bench.smooth import rms_mm, smooth_set
from bench.ssa import HIDDEN, POPULATION, standardised
from bench.subprocess_cost import Cost, cost_of
from longarm_comp.core.errors import JobError
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.network import Shape, squared_error
from longarm_comp.core.learn.population import fitness_on
from longarm_comp.core.learn.sparrow import SparrowSearch

SHAPE = Shape(7, HIDDEN, 3)


# ------------------------------------------------------------------ run in processes of their own


def fitness_rates(samples: int, population: int, device: str | None, repeats: int) -> list[float]:
    """Fitness evaluations a second: numpy where there is no device, else torch on it."""
    x, y = standardised(smooth_set(samples, 0, test=1))
    flock = np.random.default_rng(0).uniform(-1, 1, (population, SHAPE.size))
    fitness = fitness_on(device, SHAPE, x, y)
    fitness(flock[:50])
    rates = []
    for _ in range(repeats):
        begin = time.perf_counter()
        fitness(flock)
        rates.append(population / (time.perf_counter() - begin))
    return rates


def search_rate(samples: int, population: int, iterations: int) -> float:
    """Fitness evaluations a second of a whole sparrow search."""
    x, y = standardised(smooth_set(samples, 0, test=1))
    fitness, bound = squared_error(SHAPE, x, y), np.ones(SHAPE.size)
    fitness(np.zeros((50, SHAPE.size)))
    begin = time.perf_counter()
    found = SparrowSearch(population, iterations).minimise(
        fitness, -bound, bound, np.random.default_rng(0)
    )
    return found.evaluations / (time.perf_counter() - begin)


def train_once(samples: int, networks: int) -> dict[str, float]:
    """One training of networks of 12 hidden units, and its error on held-out poses."""
    data = smooth_set(samples, 0)
    begin = time.process_time()
    predictor = train(data.q, data.residual, hidden=HIDDEN, ensemble=networks)
    seconds = time.process_time() - begin
    error = predictor.predict(data.test_q).error - data.test_truth
    return {"cpu_s": seconds, "rms_mm": rms_mm(error)}


# ------------------------------------------------------------------ rows


def _fitness(name: str, samples: int, population: int, device: str, repeats: int = 3) -> Result:
    ours: Cost = cost_of(__name__, "fitness_rates", samples, population, None, repeats)
    theirs: Cost = cost_of(__name__, "fitness_rates", samples, population, device, repeats)
    return beside(
        name,
        "evaluations/s",
        ours.result,
        f"torch on {device}",
        theirs.result,
        more_is_better=True,
        grown_mb=ours.grown_mb,
        note=f"{samples} samples, population {population}; torch grows {theirs.grown_mb:.0f} MB",
    )


def ssa_fitness_population_10000() -> Result:
    """900 samples, population 10,000."""
    return _fitness("ssa_fitness_population_10000", 900, 10_000, "cpu")


def ssa_fitness_samples_100000() -> Result:
    """100,000 samples, population 50."""
    return _fitness("ssa_fitness_samples_100000", 100_000, POPULATION, "cpu")


def ssa_fitness_cuda() -> Result:
    """A graphics processor against numpy on one core, 900 samples, population 10,000."""
    name = "ssa_fitness_cuda"
    try:
        import torch
    except ImportError:
        return missing(name, "numpy on one core", "torch is not installed")
    if not torch.cuda.is_available():
        return missing(name, "numpy on one core", "no CUDA device here: not measured")
    there: Cost = cost_of(__name__, "fitness_rates", 900, 10_000, "cuda", 5)
    here: Cost = cost_of(__name__, "fitness_rates", 900, 10_000, None, 5)
    peer = "numpy on one core"
    return beside(name, "evaluations/s", there.result, peer, here.result, more_is_better=True)


def ssa_search_population_10000(population: int = 10_000, iterations: int = 1) -> Result:
    """A whole search with a large population, 900 samples."""
    name, peer = f"ssa_search_population_{population}", "mealpy 3.0.3 OriginalSSA"
    ours = cost_of(__name__, "search_rate", 900, population, iterations)
    x, y = standardised(smooth_set(900, 0, test=1))
    try:
        with MealpyPeer(x, y, HIDDEN) as other:
            answer = other.solve(population, iterations, 0)
    except JobError as error:
        return missing(name, peer, str(error))
    theirs = answer["evaluations"] / answer["seconds"]
    return beside(
        name,
        "evaluations/s",
        [ours.result],
        peer,
        [theirs],
        more_is_better=True,
        grown_mb=ours.grown_mb,
    )


def ssa_train_100000(few: int = 1_000, many: int = 100_000) -> Result:
    """One network of 12 hidden units, whole training."""
    small, large = (cost_of(__name__, "train_once", samples, 1) for samples in (few, many))
    return beside(
        f"ssa_train_{many}",
        "s CPU",
        [large.result["cpu_s"]],
        f"linear growth from {few}",
        [small.result["cpu_s"] * many / few],
        grown_mb=large.grown_mb,
        rms_mm=large.result["rms_mm"],
        note=f"{few} samples: {small.result['cpu_s']:.1f} s, {small.result['rms_mm']:.3f} mm",
    )
