"""A quickly trained predictor that uses every kind of context."""

from functools import cache
from typing import Any

import numpy as np

from bench.smooth import SmoothSet, smooth_set
from longarm_comp.core.arm.context import Context
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import Predictor, Provenance

FAST: dict[str, Any] = {"hidden": 6, "ensemble": 2, "iterations": 5, "population": 10}
ORIGIN = Provenance("arm-1", "session-1", tuple(f"joint{i}" for i in range(1, 8)))


@cache
def rows() -> SmoothSet:
    """300 rows of a smooth residual."""
    return smooth_set(300, 0)


@cache
def quick_predictor() -> tuple[Predictor, Context]:
    """The predictor, and the context of its rows."""
    rng = np.random.default_rng(1)
    side = rng.choice([-1.0, 1.0], (300, 1)) * np.ones(7)
    side[:60] = rng.choice([-1.0, 1.0], (60, 7))
    columns = {
        "temperature_c": rng.uniform(20.0, 35.0, 300),
        "payload_kg": np.full(300, 0.25),
        "t_s": np.arange(300.0),
    }
    context = Context(tuple(side.T), columns)
    residual = rows().residual + 2e-3 * side[:, :3]
    return train(rows().q, residual, context, provenance=ORIGIN, **FAST), context
