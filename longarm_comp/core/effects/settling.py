"""Changes that slow down: what warms up or settles."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import CLOCK, Context
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.effect import form


def slowing() -> float:
    """A field of an effect: one over its time constant, 1/h; 0: it goes on at a constant rate.

    An instrument warms up in a quarter of an hour or more, ground settles in hours.
    """
    return form(0.0, lower=0.0, upper=36.0, tried=(0.0, 0.25, 1.0, 4.0))


def settled_hours(context: Context, slowing: float) -> Scalar:
    """Hours at the rate of the session's start that change as much as the time until now did:
    ``(1 - exp(-slowing t)) / slowing``."""
    hours: Scalar = context.column(CLOCK, 0.0) / 3600.0
    return (1.0 - np.exp(-slowing * hours)) / slowing if slowing else hours
