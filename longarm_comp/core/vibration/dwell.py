"""How long an arm has to be left alone after its moves, of what the model says it rings by."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import Modes, modes
from longarm_comp.core.vibration.ring import Ring, along, straight


def ring_of_moves(
    model: Model, joints: np.ndarray, move_s: float, damping: float, context: Context | None = None
) -> list[tuple[Modes, Ring]]:
    """Modes at each of the postures (N, n), and the ring of the move there from the one before.

    The first is reached from the middle of the joint box.

    Args:
        move_s: time of a move, s. damping: share of critical damping.

    Raises:
        InputError: no such time or damping.
    """
    if not 0.0 < move_s < np.inf:
        raise InputError("ringing", "time of a move", move_s, "above 0 s")
    made, before = [], model.arm.mid
    for row, end in enumerate(np.atleast_2d(joints)):
        found = modes(model, end, None if context is None else context.take(row))
        made.append((found, along(found, straight(before, end, move_s), move_s, damping)))
        before = end
    return made


REST_S = 0.3
"""Rest of an arm that says nothing of its damping: servos and cameras need it too."""


def rest_s(model: Model, joints: np.ndarray, move_s: float, given: float | None) -> float:
    """How long to rest before a sighting, s: as given; else what 90 of 100 of these moves need.

    Without `damping` in arm.yaml nobody knows, and it is `REST_S`.

    Args:
        joints: (N, n) one after the other. move_s: time of a move, s.
    """
    damping = model.arm.damping
    if given is not None:
        return given
    if damping is None or not len(joints) or not move_s > 0.0:
        return REST_S
    rings = ring_of_moves(model, joints[:_LOOKED_AT], move_s, damping)
    return max(REST_S, float(np.quantile([ring.settle_s() for _, ring in rings], 0.9)))


_LOOKED_AT = 32
"""Moves that are looked at."""
