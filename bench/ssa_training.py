"""Seconds of training until a held-out error is find_cheapest, beside scikit-learn's learners.

Every learner has settings of growing cost, as a user would try them.  Only the cheapest one that
reaches the error counts.  The error is against the noise-free truth of the smooth benchmark, RMS
per axis.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from bench.comparison import Result, beside, missing
from bench.smooth import SmoothSet, rms_mm, smooth_set
from longarm_comp.core.learn.ensemble import train
from studies.peers import train_gaussian_process, train_mlp

Learner = Callable[[SmoothSet, int], Any]
TARGET_MM = {300: 0.25, 900: 0.17}
"""Error (mm) by sample size, close to the best of the slowest learner."""


def _ours(**settings: Any) -> Learner:
    return lambda data, seed: train(data.q, data.residual, seed=seed, **settings)


def _mlp(hidden: int) -> Learner:
    return lambda data, seed: train_mlp(data.q, data.residual, seed=seed, hidden=hidden)


LADDERS: dict[str, tuple[tuple[str, Learner], ...]] = {
    "ssa_bp": (
        ("one network of 8", _ours(hidden=8, ensemble=1)),
        ("one network of 12", _ours(hidden=12, ensemble=1)),
        ("two networks of 17", _ours(hidden=17, ensemble=2)),
        ("defaults", _ours()),
    ),
    "mlp": tuple((f"{hidden} hidden, alpha by CV", _mlp(hidden)) for hidden in (8, 12, 24)),
    "gp": (("ARD + white", lambda d, seed: train_gaussian_process(d.q, d.residual, seed=seed)),),
}
PEERS = {"mlp": "scikit-learn MLPRegressor", "gp": "scikit-learn GaussianProcessRegressor"}


@lru_cache(maxsize=8)
def find_cheapest(kind: str, samples: int, target_mm: float, repeats: int) -> dict[str, Any] | None:
    """The cheapest setting whose median error is below the target: seconds and errors."""
    torch.set_num_threads(1)
    for setting, learn in LADDERS[kind]:
        seconds, errors = zip(*(_train(learn, samples, s) for s in range(repeats)), strict=True)
        if np.median(errors) <= target_mm:
            return {"setting": setting, "seconds": seconds, "rms_mm": float(np.median(errors))}
    return None


def _train(learn: Learner, samples: int, seed: int) -> tuple[float, float]:
    """Processor time of one training (s), and its error (mm)."""
    data, begin = smooth_set(samples, seed), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        learned = learn(data, seed)
    seconds = time.process_time() - begin
    return seconds, rms_mm(learned.predict(data.test_q).error - data.test_truth)


def defaults(samples: int, seeds: int = 8) -> Result:
    """A training with the defaults, imports apart, in turn with scikit-learn's network."""
    torch.set_num_threads(1)
    for learn in (_ours(hidden=2, ensemble=1), _mlp(2)):
        _train(learn, 100, 0)  # imports
    pairs = [[_train(learn, samples, s) for learn in (_ours(), _mlp(24))] for s in range(seeds)]
    (ours, mine), (theirs, other) = np.transpose(pairs, (1, 2, 0))
    return beside(
        "s CPU", ours, f"{PEERS['mlp']}, 24 hidden, alpha by CV", theirs,
        rms_mm=float(np.mean(mine)), peer_rms_mm=float(np.mean(other)),
    )  # fmt: skip


def time_to_error(
    peer: str, samples: int, target_mm: float | None = None, repeats: int = 3
) -> Result:
    """One learner against ours."""
    target = target_mm or TARGET_MM[samples]
    mine = find_cheapest("ssa_bp", samples, target, repeats)
    theirs = find_cheapest(peer, samples, target, repeats)
    if mine is None or theirs is None:
        who = PEERS[peer] if mine is not None else "SSA-BP"
        return missing(PEERS[peer], f"{who} does not reach {target} mm")
    return beside(
        "s CPU",
        mine["seconds"],
        f"{PEERS[peer]}, {theirs['setting']}",
        theirs["seconds"],
        rms_mm=mine["rms_mm"],
        peer_rms_mm=theirs["rms_mm"],
        note=f"to {target} mm: {mine['setting']}",
    )
