"""Other networks beside SSA-BP on the smooth benchmark: the table of `docs/your_own_network.md`.

python -m bench.other_networks
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.smooth import SmoothSet, rms_mm, smooth_set
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.others import load_file
from studies.peers import train_gaussian_process

TWO_LAYERS = Path(__file__).parents[1] / "examples" / "two_layers.py"


def table(seeds: int = 2) -> str:
    """RMSE per axis against the noise-free truth (mm), intervals, and processor time (s)."""
    torch.set_num_threads(1)
    learners: dict[str, Callable[[SmoothSet, int], Any]] = {
        "SSA-BP, ensemble of 5": lambda s, seed: train(s.q, s.residual, seed=seed),
        "`examples/two_layers.py`, ensemble of 5": lambda s, seed: train(
            s.q, s.residual, seed=seed, network=load_file(TWO_LAYERS)
        ),
        "Gaussian process (scikit-learn)": lambda s, seed: train_gaussian_process(
            s.q, s.residual, seed=seed
        ),
    }
    lines = ["| | RMSE, 300 | RMSE, 900 | inside 90 % | s CPU, 300 | 900 |", "|---|" + "---|" * 5]
    for name, learn in learners.items():
        errors, seconds, inside = [], [], []
        for samples in (300, 900):
            each, spent = [], []
            for seed in range(seeds):
                data, begin = smooth_set(samples, seed), time.process_time()
                learned = learn(data, seed)
                spent.append(time.process_time() - begin)
                found = learned.predict(data.test_q)
                each.append(rms_mm(found.error - data.test_truth))
                left = np.abs(data.test_residual - found.error)
                inside.append(np.mean(left < 1.645 * found.sigma))
            errors.append(f"{np.mean(each):.3f}")
            seconds.append(f"{np.median(spent):.1f}")
        lines.append(f"| {' | '.join((name, *errors, f'{np.mean(inside):.2f}', *seconds))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
