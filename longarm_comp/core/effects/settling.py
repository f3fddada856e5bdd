"""Changes that slow down: what warms up, settles or creeps, with one time constant."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import CLOCK, Context
from longarm_comp.core.arm.spatial import Scalar
from longarm_comp.core.effects.effect import form

CONSTANT_RATE = 1e6
"""Time constant, s, of what goes on at the same rate for all of a session."""


def settling_time() -> float:
    """A field of an effect: its time constant, s.

    An instrument warms up in a quarter of an hour or more, ground settles in hours.
    """
    tried = (900.0, 3600.0, 14400.0, CONSTANT_RATE)
    return form(CONSTANT_RATE, lower=100.0, upper=CONSTANT_RATE, tried=tried)


def settled_hours(context: Context, time: float) -> Scalar:
    """Hours at the rate of the session's start that make the change until now, ``time`` in s:
    ``time (1 - exp(-t / time))``."""
    return -time * np.expm1(-context.column(CLOCK, 0.0) / time) / 3600.0  # type: ignore[operator]
