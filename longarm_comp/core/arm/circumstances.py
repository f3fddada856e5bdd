"""The allowed range of each circumstance, from arm.yaml where it says one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import INCLINATION
from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import range_of

MOST_K = 100.0
"""No arm works farther than this from the temperature at which its lengths are right; kelvin and
payloads written as temperatures of a hot arm do."""
MOST_PAYLOADS = 10.0
"""An arm of which arm.yaml says no more carries at most so many times what it declares, or its own
weight: no robot is known that carries more than that."""


def allowed_range(arm: Arm, name: str) -> tuple[float, float]:
    """Return the range of a circumstance, in the unit of its name; infinite without one.

    `temperature_c`: within `MOST_K` of the arm's reference. `payload_kg`: up to `payload.most_kg`
    of arm.yaml; without it, what `MOST_PAYLOADS` says; none where arm.yaml has no payload. Tilts
    (`incl_...`): a turn.
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
    """Refuse values (any shape) of a circumstance that an arm cannot be in; NaN is not judged.

    Raises:
        InputError: of a source, with the first value that is out of range, or infinite.
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
