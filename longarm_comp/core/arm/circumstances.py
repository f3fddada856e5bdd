"""The allowed range of each circumstance: from arm.yaml if declared there, else a default."""

import math

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import range_of

MOST_K = 100.0
"""Largest plausible distance (K) from the arm's reference temperature; kelvin are farther off."""
MOST_PAYLOADS = 10.0
"""Largest payload over the declared one, if arm.yaml gives no `payload.most_kg`."""


def allowed_range(arm: Arm, name: str) -> tuple[float, float]:
    """Return the lowest and highest allowed value of a circumstance, in the unit of its name.

    `temperature_c` lies within `MOST_K` of the arm's reference temperature. `payload_kg` is at most
    `payload.most_kg` of arm.yaml, else `MOST_PAYLOADS` times the declared payload or the arm's own
    mass (no known robot carries more); 0 if arm.yaml has no payload. Tilts (`incl_...`) are at most
    one turn. Other columns have the range of the unit in their name, or an infinite one.
    """
    lower, upper = range_of(name)
    if name == "temperature_c":
        at = arm.reference_temperature_c
        return max(lower, at - MOST_K), min(upper, at + MOST_K)
    if name == "payload_kg":
        if arm.payload is None:  # nobody said where it hangs
            return lower, 0.0
        own = sum(b.mass_kg for b in arm.links) + sum(m.mass_kg for m in arm.point_masses)
        usual = max(MOST_PAYLOADS * arm.payload.mass_kg, own) or upper
        return lower, usual if arm.payload.most_kg is None else arm.payload.most_kg
    return (-math.tau, math.tau) if INCLINATION.match(name) else (lower, upper)


def check_circumstance(arm: Arm, name: str, values: ArrayLike, where: object) -> None:
    """Refuse values (any shape) of a circumstance that are not possible for an arm.

    NaN is accepted.

    Args:
        where: the source of the values, as errors name it.

    Raises:
        InputError: a value is infinite or out of `allowed_range`; the error states the first one.
    """
    given = np.asarray(values, dtype=float).reshape(-1)
    lower, upper = allowed_range(arm, name)
    wrong = np.isinf(given) | (given < lower) | (given > upper)
    if wrong.any():
        allowed = f"{lower:g} to {upper:g}"
        if name == "t_s":
            allowed += " seconds"
        if name == "payload_kg" and arm.payload is None:
            allowed = f"0: arm {arm.name} declares no payload; say in arm.yaml where it hangs, "
            allowed += "payload: {mass_kg: 0, frame: ..., position_m: [...]}"
        elif name == "payload_kg":
            allowed += f" of arm {arm.name}; more: payload.most_kg in arm.yaml"
        if name == "temperature_c":
            allowed += f", {MOST_K:g} K about reference_temperature_c of arm {arm.name}"
        row = f"row {int(np.argmax(wrong)) + 1}, " if given.size > 1 else ""
        raise InputError(where, f"{row}{name}", float(given[np.argmax(wrong)]), allowed)
