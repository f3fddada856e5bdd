"""SSA-BP measured against its peers in one run: mealpy, scikit-learn, torch.

``python -m longarm_comp.bench.ssa`` prints these figures, then the tables of ``ssa_pays``.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from longarm_comp.bench.mealpy_peer import MealpyPeer
from longarm_comp.bench.smooth import SmoothSet, smooth_set
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.network import Shape, squared_error
from longarm_comp.core.learn.population import fitness_on
from longarm_comp.core.learn.sparrow import SparrowSearch
from longarm_comp.studies.peers import train_gaussian_process, train_mlp

Result = dict[str, object]

HIDDEN = 12  # D = 135 weights
POPULATION = 50
EPOCHS = 40


def evals_vs_mealpy(samples: int, repeats: int = 7) -> Result:
    """Fitness evaluations/s of a whole sparrow search against mealpy's ``OriginalSSA``.

    The same data, network, population and iterations; the two take turns, medians are compared.
    """
    x, y = _standardised(smooth_set(samples, 0))
    shape, bound = Shape(7, HIDDEN, 3), np.ones(Shape(7, HIDDEN, 3).size)
    search, fitness = SparrowSearch(POPULATION, EPOCHS), squared_error(shape, x, y)
    ours, theirs = [], []
    with MealpyPeer(x, y, HIDDEN) as peer:
        peer.solve(POPULATION, 2, 0)  # warm-up of both
        search.minimise(fitness, -bound, bound, np.random.default_rng(0))
        for seed in range(repeats):
            begin = time.perf_counter()
            found = search.minimise(fitness, -bound, bound, np.random.default_rng(seed))
            ours.append(found.evaluations / (time.perf_counter() - begin))
            answer = peer.solve(POPULATION, EPOCHS, seed)
            theirs.append(answer["evaluations"] / answer["seconds"])
    ratios = np.array(ours) / np.array(theirs)
    return {
        "name": f"ssa_evals_vs_mealpy_{samples}",
        "value": float(np.median(ours)),
        "unit": "evaluations/s",
        "peer": "mealpy 3.0.3 OriginalSSA",
        "peer_value": float(np.median(theirs)),
        "ratio": float(np.median(ratios)),
        "spread": [float(ratios.min()), float(ratios.max())],
    }


def ssa_evals_vs_mealpy_300(repeats: int = 7) -> Result:
    """At 300 samples; goal 8."""
    return evals_vs_mealpy(300, repeats)


def ssa_evals_vs_mealpy_900(repeats: int = 7) -> Result:
    """At 900 samples; goal 6."""
    return evals_vs_mealpy(900, repeats)


def training_vs_sklearn(samples: int = 900, repeats: int = 3) -> list[Result]:
    """Seconds to a trained model beside the held-out error that it reaches.

    ``rms_mm`` and ``peer_rms_mm`` are against the noise-free truth: a ratio above 1 counts only
    where the error is no worse.
    """
    kinds: dict[str, Callable[[SmoothSet], NDArray[np.float64]]] = {
        "ssa_bp": lambda s: train(s.q, s.residual).predict(s.test_q).error,
        "gp": lambda s: train_gaussian_process(s.q, s.residual).predict(s.test_q).error,
        "mlp": lambda s: train_mlp(s.q, s.residual).predict(s.test_q).error,
    }
    names = {"gp": "scikit-learn GP, ARD + white", "mlp": "scikit-learn MLP lbfgs, CV alpha"}
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}
    rms: dict[str, list[float]] = {kind: [] for kind in kinds}
    for seed in range(repeats):
        data = smooth_set(samples, seed)
        for kind, learn in kinds.items():
            begin = time.perf_counter()
            error = learn(data) - data.test_truth
            seconds[kind].append(time.perf_counter() - begin)
            rms[kind].append(1e3 * float(np.sqrt(np.mean(error**2))))
    made = []
    for kind, name in names.items():
        ratios = np.array(seconds[kind]) / np.array(seconds["ssa_bp"])
        made.append(
            {
                "name": f"ssa_bp_training_vs_{kind}_{samples}",
                "value": float(np.median(seconds["ssa_bp"])),
                "unit": "s",
                "peer": name,
                "peer_value": float(np.median(seconds[kind])),
                "ratio": float(np.median(ratios)),
                "spread": [float(ratios.min()), float(ratios.max())],
                "rms_mm": float(np.mean(rms["ssa_bp"])),
                "peer_rms_mm": float(np.mean(rms[kind])),
            }
        )
    return made


def scaling(
    sizes: tuple[tuple[int, int], ...] = ((300, 50), (900, 50), (900, 1000), (900, 10_000),
                                          (10_000, 50), (100_000, 50)),
    device: str = "cpu",
    repeats: int = 3,
) -> list[Result]:  # fmt: skip
    """Fitness evaluations/s of (samples, population): numpy against torch on ``device``."""
    made: list[Result] = []
    shape = Shape(7, HIDDEN, 3)
    for samples, population in sizes:
        x, y = _standardised(smooth_set(samples, 0, test=1))
        flock = np.random.default_rng(0).uniform(-1, 1, (population, shape.size))
        rates = []
        for place in (None, device):
            fitness = fitness_on(place, shape, x, y)
            fitness(flock[:50])
            taken = []
            for _ in range(repeats):
                begin = time.perf_counter()
                fitness(flock)
                taken.append(time.perf_counter() - begin)
            rates.append(population / np.array(taken))
        ratios = rates[0] / rates[1]
        made.append(
            {
                "name": f"ssa_fitness_n{samples}_p{population}",
                "value": float(np.median(rates[0])),
                "unit": "evaluations/s",
                "peer": f"torch {device}",
                "peer_value": float(np.median(rates[1])),
                "ratio": float(np.median(ratios)),
                "spread": [float(ratios.min()), float(ratios.max())],
            }
        )
    return made


def _standardised(data: SmoothSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x = (data.q - data.q.mean(axis=0)) / data.q.std(axis=0)
    y = (data.residual - data.residual.mean(axis=0)) / data.residual.std()
    return x, y


def _show(results: list[Result]) -> None:
    for r in results:
        extra = "".join(f"  {k} {r[k]:.3f}" for k in ("rms_mm", "peer_rms_mm") if k in r)
        print(
            f"{r['name']:32s} {r['value']:12.4g} {r['unit']}  {r['peer']}: {r['peer_value']:.4g}"
            f"  ratio {r['ratio']:.2f}{extra}",
            flush=True,
        )


if __name__ == "__main__":
    from longarm_comp.bench.ssa_pays import tables

    _show([ssa_evals_vs_mealpy_300(), ssa_evals_vs_mealpy_900()])
    _show(scaling())
    _show(training_vs_sklearn(300))
    _show(training_vs_sklearn(900))
    for text in tables():
        print(text, flush=True)
