"""Many targets, or realisable joints of many, as arrays."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.realisable import Lattice, Predict, choose
from longarm_comp.core.model.model import Model


def stack(rows: Sequence[Any]) -> SimpleNamespace:
    """Stack fields of records of one kind by a leading axis; texts and records as a list."""
    made: dict[str, Any] = {}
    for name in vars(rows[0]):
        values = [getattr(row, name) for row in rows]
        alike = isinstance(values[0], float | int | bool | np.ndarray | np.generic)
        made[name] = np.array(values) if alike else values
    return SimpleNamespace(**made, rows=list(rows))


def compensate_arrays(
    model: Model, predictor: Any, targets: np.ndarray, **given: Any
) -> SimpleNamespace:
    """Call `compensate` and return its answers as arrays."""
    made = stack(compensate(model, predictor, targets, **given))
    made.success = np.array([row.success for row in made.rows])
    return made


def choose_arrays(
    arm: Arm, lattice: Lattice, predict: Predict, targets: np.ndarray, ideal: np.ndarray,
    *given: Any, **options: Any,
) -> SimpleNamespace:  # fmt: skip
    """Call `choose` for each of N targets and return its answers as arrays."""
    pairs = zip(targets, ideal, strict=True)
    return stack([choose(arm, lattice, predict, t, q, *given, **options) for t, q in pairs])
