"""The correction of a command, physics and learned error together, and its permitted size."""

from dataclasses import replace

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.ik.solver import position_of
from longarm_comp.core.model.link_frames import reach
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import lengths

SHARE_OF_REACH = 0.1
"""Largest correction as a share of the arm's reach, if no other is stated.

Beams that bend by more than a tenth of their length do not bend linearly, as the model assumes.
"""


def measure_correction(
    model: Model, q: np.ndarray, targets: np.ndarray, context: Context
) -> np.ndarray:
    """Return how far commands move the tip of the declared, rigid arm from its targets, (N,) m.

    The declared arm stands where the model's base stands: that is no correction.

    Args:
        q: (N, n) commanded joints, rad and m.
        targets: (N, 3) m or (N, 4, 4).
        context: circumstances of all, or of each.
    """
    joints = q[0] if len(q) == 1 else q  # floats are quicker than arrays of one
    return lengths(_declared_on_base(model).tip(joints, context) - position_of(targets))


def permitted_correction(model: Model, stated_m: float | None) -> float:
    """Return the largest permitted correction, m: as stated, else `SHARE_OF_REACH` of the reach."""
    if stated_m is not None:
        return stated_m
    declared = _declared_on_base(model)
    if "reach_m" not in declared.memo:
        declared.memo["reach_m"] = reach(declared)[1]
    return SHARE_OF_REACH * float(declared.memo["reach_m"])


def describe_too_large(size_m: float, permitted_m: float) -> str:
    """Say that a correction is too large, and what may be wrong."""
    most = f"the permitted {1e3 * permitted_m:.4g} mm (max_correction_m)"
    return f"the correction of {1e3 * size_m:.2f} mm is above {most}"


def _declared_on_base(model: Model) -> Model:
    """Return the declared arm without effects, but with its base where the model has it."""
    if "declared_on_base" not in model.memo:
        bases = tuple(e for e in model.effects if e.base(model.arm) is not None)
        model.memo["declared_on_base"] = replace(model, effects=bases, elements_per_beam=1)
    made: Model = model.memo["declared_on_base"]
    return made
