"""Columns of a model's parameters by central differences, to compare with its own."""

from collections.abc import Callable, Iterator

import numpy as np

from longarm_comp.core.data.measurement import make_equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model, Slot


def numeric_columns(
    model: Model, session: Session, step_of: Callable[[Slot], float]
) -> Iterator[tuple[int, Slot, np.ndarray]]:
    """Yield number and slot of each parameter, and its (N, d) derivative of the prediction."""
    for k, slot in enumerate(model.slots):
        step = step_of(slot) * np.eye(len(model.values))[k]
        ends = [model.with_values(model.values + sign * step) for sign in (1.0, -1.0)]
        up, down = (make_equations(m, session, ()).residual for m in ends)
        yield k, slot, (down - up) / (2 * step[k])
