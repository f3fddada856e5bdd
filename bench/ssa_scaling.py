"""SSA-BP against mealpy, samples and population: rates, seconds and memory."""

from __future__ import annotations

import time

import torch

from bench.comparison import Result, beside, missing
from bench.peer_process import PeerProcess
from bench.smooth import rms_mm, smooth_set
from bench.ssa_problem import SHAPE, SsaProblem
from bench.subprocess_cost import cost_of
from longarm_comp.core.errors import JobError
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.sparrow import SparrowSearch

NAME = "bench.ssa_scaling"
"""Of this module, also where it is run as a program."""
MEALPY = "mealpy 3.0.3 OriginalSSA"
NO_GPU = "no GPU at hand: torch sees none on this machine"

# ------------------------------------------------------------------ run in processes of their own


def search_rate(samples: int, population: int, iterations: int, device: str = "cpu") -> float:
    """Fitness evaluations a second of a whole sparrow search."""
    problem = SsaProblem.of(samples, device=device, test=1)
    problem.search(50, 1, 0)
    begin = time.perf_counter()
    _, found = problem.search(population, iterations, 0)
    float(found[0])  # waits for a GPU
    return SparrowSearch(population, iterations).evaluations / (time.perf_counter() - begin)


def train_once(samples: int, networks: int, device: str = "cpu") -> dict[str, float]:
    """One training of networks of 12 hidden units, and its error on held-out poses."""
    data, few = smooth_set(samples, 0), smooth_set(100, 0)
    train(few.q, few.residual, hidden=4, ensemble=1, device=device)  # imports, and wakes a GPU
    begun, begin = time.perf_counter(), time.process_time()
    predictor = train(data.q, data.residual, hidden=SHAPE.hidden, ensemble=networks, device=device)
    seconds, wall = time.process_time() - begin, time.perf_counter() - begun
    error = predictor.predict(data.test_q).error - data.test_truth
    return {"cpu_s": seconds, "wall_s": wall, "rms_mm": rms_mm(error)}


# ------------------------------------------------------------------ rows


def evals_vs_mealpy(samples: int, repeats: int = 7) -> Result:
    """Fitness evaluations/s of a whole sparrow search against mealpy's ``OriginalSSA``.

    Goals: 8 at 300 samples, 6 at 900.
    The same data, network, population and iterations; the two take turns, medians are compared.
    """
    torch.set_num_threads(1)
    problem = SsaProblem.of(samples)
    evaluations = SparrowSearch(50, 40).evaluations
    ours: list[float] = []
    theirs: list[float] = []
    with _start_mealpy(problem) as peer:
        _mealpy_rate(peer, 50, 2, 0)  # warm-up of both
        problem.search(50, 40, 0)
        for seed in range(repeats):
            begin = time.perf_counter()
            problem.search(50, 40, seed)
            ours.append(evaluations / (time.perf_counter() - begin))
            theirs.append(_mealpy_rate(peer, 50, 40, seed))
    return beside("evaluations/s", ours, MEALPY, theirs, more_is_better=True)


def search_population(population: int, iterations: int = 1) -> Result:
    """A whole search with a large population, 900 samples."""
    ours = cost_of(NAME, "search_rate", 900, population, iterations)
    try:
        with _start_mealpy(SsaProblem.of(900, test=1)) as other:
            theirs = _mealpy_rate(other, population, iterations, 0)
    except JobError as error:
        return missing(MEALPY, str(error))
    return beside(
        "evaluations/s", [ours.result], MEALPY, [theirs], more_is_better=True,
        grown_mb=ours.grown_mb,
    )  # fmt: skip


def _start_mealpy(problem: SsaProblem) -> PeerProcess:
    x, y = problem.standardised
    return PeerProcess("mealpy", x=x, y=y)


def _mealpy_rate(peer: PeerProcess, population: int, epochs: int, seed: int) -> float:
    """Run one search of mealpy, and return its fitness evaluations a second."""
    size = {"hidden": SHAPE.hidden, "population": population}
    answer = peer.ask(**size, epochs=epochs, seed=seed)
    return answer["evaluations"] / answer["seconds"]


def train_many(many: int, few: int = 1_000) -> Result:
    """One network of 12 hidden units, whole training."""
    small, large = (cost_of(NAME, "train_once", samples, 1) for samples in (few, many))
    return beside(
        "s CPU",
        [large.result["cpu_s"]],
        f"linear growth from {few}",
        [small.result["cpu_s"] * many / few],
        grown_mb=large.grown_mb,
        rms_mm=large.result["rms_mm"],
        note=f"{few} samples: {small.result['cpu_s']:.1f} s, {small.result['rms_mm']:.3f} mm",
    )


def search_on_gpu(population: int, iterations: int = 5) -> Result:
    """The same search on a GPU and on one core, 900 samples. Goal: 20."""
    if not torch.cuda.is_available():
        return missing("one core of this CPU", NO_GPU)
    gpu, core = (
        cost_of(NAME, "search_rate", 900, population, iterations, device).result
        for device in ("cuda", "cpu")
    )
    return beside("evaluations/s", [gpu], "one core of this CPU", [core], more_is_better=True)


def train_on_gpu(samples: int) -> Result:
    """The same training on a GPU and on one core. Goal: 20."""
    if not torch.cuda.is_available():
        return missing("one core of this CPU", NO_GPU)
    gpu, core = (
        cost_of(NAME, "train_once", samples, 5, device).result for device in ("cuda", "cpu")
    )
    return beside(
        "s", [gpu["wall_s"]], "one core of this CPU", [core["wall_s"]], rms_mm=gpu["rms_mm"]
    )


if __name__ == "__main__":  # `python -m bench.ssa_scaling`: what needs a GPU
    for found in (search_on_gpu(10_000), train_on_gpu(100_000)):
        print(found, flush=True)
