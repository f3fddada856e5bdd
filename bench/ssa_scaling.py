"""SSA-BP against samples and population: rates, seconds and memory, each in its own process."""

from __future__ import annotations

import time

import numpy as np

from bench.comparison import Result, beside, missing
from bench.mealpy_peer import MealpyPeer
from bench.smooth import rms_mm, smooth_set
from bench.ssa import HIDDEN, standardised
from bench.subprocess_cost import cost_of
from longarm_comp.core.errors import JobError
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.network import NetworkShape, squared_error
from longarm_comp.core.learn.sparrow import SparrowSearch

SHAPE = NetworkShape(7, HIDDEN, 3)


# ------------------------------------------------------------------ run in processes of their own


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


def search_population(population: int, iterations: int = 1) -> Result:
    """A whole search with a large population, 900 samples."""
    peer = "mealpy 3.0.3 OriginalSSA"
    ours = cost_of(__name__, "search_rate", 900, population, iterations)
    x, y = standardised(smooth_set(900, 0, test=1))
    try:
        with MealpyPeer(x, y, HIDDEN) as other:
            answer = other.solve(population, iterations, 0)
    except JobError as error:
        return missing(peer, str(error))
    theirs = answer["evaluations"] / answer["seconds"]
    return beside(
        "evaluations/s",
        [ours.result],
        peer,
        [theirs],
        more_is_better=True,
        grown_mb=ours.grown_mb,
    )


def train_many(many: int, few: int = 1_000) -> Result:
    """One network of 12 hidden units, whole training."""
    small, large = (cost_of(__name__, "train_once", samples, 1) for samples in (few, many))
    return beside(
        "s CPU",
        [large.result["cpu_s"]],
        f"linear growth from {few}",
        [small.result["cpu_s"] * many / few],
        grown_mb=large.grown_mb,
        rms_mm=large.result["rms_mm"],
        note=f"{few} samples: {small.result['cpu_s']:.1f} s, {small.result['rms_mm']:.3f} mm",
    )
