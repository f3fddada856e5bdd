"""Benefit of the sparrow search: the table of `docs/ssa_bp.md`.

python -m bench.ssa_pays
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.smooth import rms_mm
from bench.ssa_problem import SsaProblem
from longarm_comp.core.learn.ensemble import train
from studies.peers import train_gaussian_process


def compare_starts(seeds: int = 4) -> str:
    """Make a Markdown table of the RMSE by start and training, at 300 and 900 samples."""
    rows: dict[str, list[str]] = {}
    for samples in (300, 900):
        found: dict[str, list[float]] = {}
        for seed in range(seeds):
            for name, value in _errors_mm(samples, seed):
                found.setdefault(name, []).append(value)
        for name, values in found.items():
            cell = f"{np.mean(values):.3f} ± {np.std(values, ddof=1) / len(values) ** 0.5:.3f}"
            rows.setdefault(name, []).append(cell)
    lines = [f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items()]
    return "\n".join(["| RMSE per axis, mm | 300 | 900 |", "|---|---|---|", *lines])


def _errors_mm(samples: int, seed: int) -> Iterator[tuple[str, float]]:
    problem = SsaProblem.of(samples, seed)
    data, truth = problem.data, problem.data.test_truth
    starts = {name: problem.start(name.lower(), seed) for name in ("SSA", "Xavier")}
    for name, start in starts.items():
        yield f"{name} weights alone", problem.rms_mm(start)
    for name, start in starts.items():
        fit = problem.fit(start)
        yield f"{name} start + LM, evidence, ARD (one network of 12)", problem.rms_mm(fit.weights)
    predictor = train(data.q, data.residual, init="ssa", seed=seed)
    error = predictor.predict(data.test_q).error - truth
    yield '`train(init="ssa")`: ensemble of 5', rms_mm(error)
    gaussian = train_gaussian_process(data.q, data.residual)
    yield "Gaussian process, ARD + white", rms_mm(gaussian.predict(data.test_q).error - truth)


if __name__ == "__main__":
    print(compare_starts())
