"""The proof: every model on poses that no fit has seen.  It reports; it selects nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import errors, turns
from longarm_comp.core.data.session import Session
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model

NETWORK = "with_network"
"""Name of the stage with a learned correction on top of the model."""


@dataclass(frozen=True)
class Proof:
    """Held-out errors of every model.

    Attributes:
        errors: by model name, (M, 3) measured - predicted of the rows that say where the tip is,
            m (`core/data/measurement.py`).
        commanded: the same as a command would have them (`core/data/commanded.py`).
        turned: by model name, (K, 3) of the rows that say how the tip is turned, rad.
    """

    errors: Mapping[str, np.ndarray]
    commanded: Mapping[str, np.ndarray]
    turned: Mapping[str, np.ndarray]

    @property
    def rows(self) -> dict[str, Errors]:
        """Figures of `errors` by model name."""
        return {name: Errors.of(error, self.turned[name]) for name, error in self.errors.items()}


def prove(
    models: Mapping[str, Model], network: tuple[Model, Predictor] | None, rows: Session
) -> Proof:
    """Errors of every model on the hold-out.

    Args:
        models: by name, in the order of the ladder.
        network: a learned correction and the model that it stands on; inside its domain only.
        rows: the hold-out, in time order, all rows seen.
    """
    seen = {name: errors(model, rows) for name, model in models.items()}
    told = {name: commanded_errors(model, rows) for name, model in models.items()}
    turned = {name: turns(model, rows) for name, model in models.items()}
    if network is not None:
        model, learned = network
        placed = rows.take(rows.placed)
        expected = learned.predict(placed.q, placed.context())
        known = (expected.in_domain & placed.located)[:, None]
        error = np.where(known, expected.error, 0.0)
        seen[NETWORK] = errors(model, placed) - error
        told[NETWORK] = commanded_errors(model, placed) - error
        turned[NETWORK] = turns(model, placed)
    return Proof(seen, told, turned)
