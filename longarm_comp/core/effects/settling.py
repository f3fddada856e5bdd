"""Changes that slow down: what warms up or settles."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import CLOCK, Context
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.effect import form


def slowing() -> float:
    """Declare a field: one over the time constant, 1/h; 0: it goes on at a constant rate.

    An instrument warms up in a quarter of an hour or more, ground settles in hours.
    """
    return form(0.0, lower=0.0, upper=36.0, tried=(0.0, 0.25, 1.0, 4.0))


def settled(context: Context, slowing: float) -> Scalar:
    """Return how far a change has gone by now, as a share of its first hour:
    ``(1 - exp(-slowing t)) / (1 - exp(-slowing))``, t in hours."""
    hours: Scalar = context.column(CLOCK, 0.0) / 3600.0
    return (1.0 - np.exp(-slowing * hours)) / (1.0 - np.exp(-slowing)) if slowing else hours
