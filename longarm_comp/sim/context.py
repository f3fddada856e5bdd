"""Circumstances of the simulated arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError

Array = np.ndarray


@dataclass(frozen=True)
class TrueContext:
    """Circumstances of N postures. None means as declared, or unknown."""

    approach: Array | None = None
    """Side each joint arrived from, (N, n) or (n,) of -1, 0, +1: from below is +1."""
    temperature_c: Array | float | None = None  # (N,) or one number, degrees Celsius
    payload_kg: Array | float | None = None  # carried mass, (N,) or one number
    t_s: Array | float | None = None  # time since the session began, (N,) or one number
    behind: Array | None = None
    """How far each joint is behind its command by its own past (friction as a stack of sliders),
    (N, n) or (n,), rad or m."""
    wound: Array | None = None
    """How far each joint's gear train is wound up, (N, n) or (n,), -1 to +1: fully by motion
    downwards or upwards."""
    way: Array | None = None
    """Displacement of each joint since it last stood still or reversed, (N, n) or (n,), rad or m:
    upwards positive."""


@dataclass(frozen=True)
class State:
    """N postures as commanded, with every circumstance filled in."""

    arm: Arm
    q: Array
    approach: Array
    temperature_c: Array
    payload_kg: Array
    t_s: Array
    behind: Array
    wound: Array
    way: Array

    @classmethod
    def of(cls, arm: Arm, q: Array, context: TrueContext | None) -> State:
        """Create from joints and a context, with defaults for None."""
        q = _array_of("q", q, (len(np.atleast_2d(q)), arm.n))
        usual = {
            "temperature_c": arm.reference_temperature_c,
            "payload_kg": arm.payload.mass_kg if arm.payload else 0.0,
        }
        filled = {}
        for name, value in vars(context or TrueContext()).items():
            shape = q.shape if name in ("approach", "behind", "wound", "way") else q.shape[:1]
            filled[name] = _array_of(name, usual.get(name, 0.0) if value is None else value, shape)
        return cls(arm, q, **filled)


def _array_of(name: str, value: Array | float, shape: tuple[int, ...]) -> Array:
    try:
        array = np.broadcast_to(np.asarray(value, float), shape)
    except (TypeError, ValueError) as error:
        raise InputError(
            "simulated arm", name, f"shape {np.shape(value)}", f"numbers of shape {shape}"
        ) from error
    if not np.all(np.isfinite(array)):
        raise InputError("simulated arm", name, "not finite", "finite numbers")
    return array
