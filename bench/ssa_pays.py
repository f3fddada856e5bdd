"""Benefit of the sparrow search. Tables of ``docs/ssa_bp.md``: starts, errata, origin bias."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, differential_evolution

from bench.smooth import SmoothSet, rms_mm, smooth_set
from bench.sparrow_as_printed import RULES
from longarm_comp.core.learn.ensemble import back_propagate, train
from longarm_comp.core.learn.network import (
    SPARROW_BOUND,
    NetworkShape,
    forward,
    hidden_alike,
    sparrow_start,
    squared_error,
    with_ones,
    xavier_start,
)
from longarm_comp.core.learn.sparrow import SparrowResult, SparrowSearch
from studies.peers import train_gaussian_process, train_mlp

Array = NDArray[np.float64]
SHAPE = NetworkShape(7, 12, 3)


def tables(seeds: int = 4) -> Iterator[str]:
    """The tables in Markdown, one by one as they are done."""
    yield starts(seeds)
    yield errata()
    yield origin_bias()


class _Problem:
    """The smooth residual in standardised units."""

    def __init__(self, samples: int, seed: int) -> None:
        data: SmoothSet = smooth_set(samples, seed)
        mean, sd = data.q.mean(axis=0), data.q.std(axis=0)
        self.data, self.scale = data, float(data.residual.std())
        self.offset = data.residual.mean(axis=0)
        self.x, self.test_x = (data.q - mean) / sd, with_ones((data.test_q - mean) / sd)
        self.y = (data.residual - self.offset) / self.scale

    def rms_mm(self, weights: Array) -> float:
        """Held-out RMSE per axis against the noise-free truth."""
        outputs = forward(SHAPE, weights, self.test_x) * self.scale + self.offset
        return rms_mm(outputs - self.data.test_truth)

    def search(self, rng: np.random.Generator, form: str, iterations: int) -> SparrowResult:
        """The raw search, without the guard against collapsed units."""
        bound = np.full(SHAPE.size, SPARROW_BOUND)
        fitness = squared_error(SHAPE, self.x, self.y)
        return SparrowSearch(50, iterations, rules=RULES[form]).minimise(
            fitness, -bound, bound, rng
        )


def starts(seeds: int) -> str:
    """RMSE by start and training, at 300 and 900 samples."""
    rows: dict[str, list[str]] = {}
    for samples in (300, 900):
        found: dict[str, list[float]] = {}
        for seed in range(seeds):
            for name, value in _one_seed(samples, seed):
                found.setdefault(name, []).append(value)
        for name, values in found.items():
            cell = f"{np.mean(values):.3f} ± {np.std(values, ddof=1) / len(values) ** 0.5:.3f}"
            rows.setdefault(name, []).append(cell)
    lines = [f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items()]
    return "\n".join(["", "| RMSE per axis, mm | 300 | 900 |", "|---|---|---|", *lines])


def _one_seed(samples: int, seed: int) -> Iterator[tuple[str, float]]:
    problem = _Problem(samples, seed)
    data, truth = problem.data, problem.data.test_truth
    fitness = squared_error(SHAPE, problem.x, problem.y)
    sparrow = sparrow_start(SHAPE, fitness, np.random.default_rng(seed), SparrowSearch(50, 50))
    xavier = xavier_start(SHAPE, np.random.default_rng(seed))
    yield "SSA weights alone", problem.rms_mm(sparrow)
    yield "Xavier weights alone", problem.rms_mm(xavier)
    for name, start in (("SSA", sparrow), ("Xavier", xavier)):
        yield f"{name} start + Adam 300 steps", problem.rms_mm(_adam(problem, start, 300))
    for name, start in (("SSA", sparrow), ("Xavier", xavier)):
        fit = back_propagate(SHAPE, start, problem.x, problem.y)
        yield f"{name} start + LM, evidence, ARD (one network)", problem.rms_mm(fit.weights)
    for init in ("ssa", "xavier"):
        predictor = train(data.q, data.residual, init=init, seed=seed)
        name = f'`train(init="{init}")`: size by evidence, ensemble of 5'
        yield name, rms_mm(predictor.predict(data.test_q).error - truth)
    gaussian = train_gaussian_process(data.q, data.residual)
    yield "Gaussian process, ARD + white", rms_mm(gaussian.predict(data.test_q).error - truth)
    mlp = train_mlp(data.q, data.residual, seed=seed)
    yield "MLPRegressor lbfgs, CV alpha", rms_mm(mlp.predict(data.test_q).error - truth)


def _adam(problem: _Problem, start: Array, steps: int, rate: float = 0.01) -> Array:
    """Plain first-order training, full batch: the kind of training that a start can help."""
    weights, mean, square = start.copy(), np.zeros(SHAPE.size), np.zeros(SHAPE.size)
    x1, y = with_ones(problem.x), problem.y
    for step in range(1, steps + 1):
        v, w, b = SHAPE.split(weights)
        z = np.tanh(x1 @ v)
        error = (z @ w + b - y) / len(y)
        slope = (error @ w.T) * (1 - z * z)
        parts = ((x1.T @ slope).ravel(), (z.T @ error).ravel(), error.sum(axis=0))
        gradient = np.concatenate(parts)
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        scaled = np.sqrt(square / (1 - 0.999**step)) + 1e-8
        weights -= rate * mean / (1 - 0.9**step) / scaled
    return weights


def errata(runs: int = 60, iterations: int = 200) -> str:
    """Canonical against printed Eq. (6)-(8): result of the search, collapsed starts, and result of
    one unguarded training from them."""
    problem = _Problem(300, 0)
    columns = (
        "form",
        "search ends at, mm",
        "all units alike",
        "some alike",
        "after LM, mm",
        "worst",
    )
    lines = ["", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for form in ("canonical", "printed"):
        ends, after, whole, some = [], [], 0, 0
        for seed in range(runs):
            weights = problem.search(np.random.default_rng(seed), form, iterations).position
            alike = int(hidden_alike(SHAPE, weights).sum())
            whole += alike >= SHAPE.hidden - 1
            some += alike > 0
            ends.append(problem.rms_mm(weights))
            fit = back_propagate(SHAPE, weights, problem.x, problem.y, max_steps=60)
            after.append(problem.rms_mm(fit.weights))
        lines.append(
            f"| {form} | {np.median(ends):.2f} | {whole} of {runs} | {some} of {runs} | "
            f"{np.median(after):.2f} | {np.max(after):.2f} |"
        )
    return "\n".join(lines)


def origin_bias(runs: int = 9, dims: int = 20, iterations: int = 200) -> str:
    """Median best value of a sphere, centred and shifted at random, at equal evaluations."""
    lines = ["", f"| sphere, D = {dims}, [-5, 5] | centred | shifted |", "|---|---|---|"]
    lower, upper = np.full(dims, -5.0), np.full(dims, 5.0)

    def sparrow(form: str) -> Callable[[Array, int], float]:
        def solve(centre: Array, seed: int) -> float:
            search, rng = (
                SparrowSearch(50, iterations, rules=RULES[form]),
                np.random.default_rng(seed),
            )
            return search.minimise(
                lambda x: np.sum((x - centre) ** 2, axis=1), lower, upper, rng
            ).fitness

        return solve

    def evolution(centre: Array, seed: int) -> float:
        budget = 50 + iterations * 55
        found = differential_evolution(
            lambda x: np.sum((x - centre[:, None]) ** 2, axis=0), Bounds(lower, upper),
            popsize=50 // dims + 1, maxiter=budget // (dims * (50 // dims + 1)) - 1, tol=0.0,
            polish=False, rng=seed, vectorized=True, updating="deferred",
        )  # fmt: skip
        return float(found.fun)

    solvers = {
        "SSA canonical": sparrow("canonical"),
        "SSA printed": sparrow("printed"),
        "scipy differential evolution": evolution,
    }
    for name, solve in solvers.items():
        centred, shifted = [], []
        for seed in range(runs):
            centre = np.random.default_rng(1000 + seed).uniform(-3.0, 3.0, dims)
            centred.append(solve(np.zeros(dims), seed))
            shifted.append(solve(centre, seed))
        lines.append(f"| {name} | {np.median(centred):.2g} | {np.median(shifted):.2g} |")
    return "\n".join(lines)


if __name__ == "__main__":
    for text in tables():
        print(text, flush=True)
