"""Benefit of the sparrow search. Tables of ``docs/ssa_bp.md``: starts, errata, origin bias."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import Bounds, differential_evolution

from bench.smooth import rms_mm
from bench.sparrow_as_printed import RULES
from bench.ssa_problem import SHAPE, SsaProblem
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.sparrow import SparrowSearch
from longarm_comp.core.learn.stack import hidden_alike
from studies.peers import train_gaussian_process, train_mlp

Array = NDArray[np.float64]


def tables(seeds: int = 4) -> Iterator[str]:
    """The tables in Markdown, one by one as they are done."""
    yield starts(seeds)
    yield errata()
    yield origin_bias()


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
    problem = SsaProblem.of(samples, seed)
    data, truth = problem.data, problem.data.test_truth
    sparrow, xavier = (problem.start(init, seed) for init in ("ssa", "xavier"))
    yield "SSA weights alone", problem.rms_mm(sparrow)
    yield "Xavier weights alone", problem.rms_mm(xavier)
    for name, start in (("SSA", sparrow), ("Xavier", xavier)):
        yield f"{name} start + Adam 300 steps", problem.rms_mm(_adam(problem, start, 300))
    for name, start in (("SSA", sparrow), ("Xavier", xavier)):
        fit = problem.fit(start)
        yield f"{name} start + LM, evidence, ARD (one network)", problem.rms_mm(fit.weights)
    for init in ("ssa", "xavier"):
        predictor = train(data.q, data.residual, init=init, seed=seed)
        name = f'`train(init="{init}")`: size by evidence, ensemble of 5'
        yield name, rms_mm(predictor.predict(data.test_q).error - truth)
    gaussian = train_gaussian_process(data.q, data.residual)
    yield "Gaussian process, ARD + white", rms_mm(gaussian.predict(data.test_q).error - truth)
    mlp = train_mlp(data.q, data.residual, seed=seed)
    yield "MLPRegressor lbfgs, CV alpha", rms_mm(mlp.predict(data.test_q).error - truth)


def _adam(problem: SsaProblem, start: torch.Tensor, steps: int) -> torch.Tensor:
    """Plain first-order training, full batch: the kind of training that a start can help."""
    weights, (x, y, _) = start.clone().requires_grad_(), problem.rows
    adam = torch.optim.Adam([weights], lr=0.01)
    for _ in range(steps):
        adam.zero_grad()
        torch.mean((problem.stack.outputs(weights, x) - y) ** 2).backward()
        adam.step()
    return weights.detach()


def errata(runs: int = 60, iterations: int = 200) -> str:
    """Canonical against printed Eq. (6)-(8): result of the search, collapsed starts, and result of
    one unguarded training from them."""
    problem = SsaProblem.of(300)
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
            weights = problem.search(50, iterations, seed, RULES[form])[0]
            alike = int(hidden_alike(SHAPE.split(weights)[0]).sum())
            whole += alike >= SHAPE.hidden - 1
            some += alike > 0
            ends.append(problem.rms_mm(weights))
            fit = problem.fit(weights, max_steps=60)
            after.append(problem.rms_mm(fit.weights))
        lines.append(
            f"| {form} | {np.median(ends):.2f} | {whole} of {runs} | {some} of {runs} | "
            f"{np.median(after):.2f} | {np.max(after):.2f} |"
        )
    return "\n".join(lines)


def origin_bias(runs: int = 9, dims: int = 20, iterations: int = 200) -> str:
    """Median best value of a sphere, centred and shifted at random, at equal evaluations."""
    lines = ["", f"| sphere, D = {dims}, [-5, 5] | centred | shifted |", "|---|---|---|"]
    bound = torch.full((1, dims), 5.0, dtype=torch.float64)

    def sparrow(form: str) -> Callable[[Array, int], float]:
        def solve(centre: Array, seed: int) -> float:
            search, rng = SparrowSearch(50, iterations, rules=RULES[form]), torch.Generator()
            at = torch.as_tensor(centre)
            _, found = search.minimise(
                lambda x: ((x - at) ** 2).sum(2), -bound, bound, rng.manual_seed(seed)
            )
            return float(found[0])

        return solve

    def evolution(centre: Array, seed: int) -> float:
        budget = 50 + iterations * 55
        found = differential_evolution(
            lambda x: np.sum((x - centre[:, None]) ** 2, axis=0),
            Bounds(np.full(dims, -5.0), np.full(dims, 5.0)),
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
