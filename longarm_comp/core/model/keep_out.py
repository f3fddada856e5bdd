"""Whether a move enters a box that the arm must keep out of."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from longarm_comp.core.model.model import Model
from longarm_comp.core.model.outline import outline

_STEPS = 16
"""Postures looked at from one way-point to the next."""


def entered(model: Model, path: np.ndarray) -> str:
    """Which box a move enters, where, and at which joints; empty if it enters none.

    The arm is the line through its stations, from the foot to the tip: a box must be larger than
    the thing that it protects by the arm's radius. Between way-points joints move straight.

    Args:
        model: where the arm hangs.
        path: (k, n) way-points, the first where the arm stands; rad, m.
    """
    boxes = model.arm.keep_out
    if not boxes:
        return ""
    for start, end in pairwise(path):
        for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
            q = start + share * (end - start)
            points = outline(model, q)
            for name, box in boxes.items():
                parts = np.flatnonzero(box.crossed(points))
                if len(parts):
                    near, at = (_listed(numbers) for numbers in (points[parts[0] + 1], q))
                    return f"keep_out {name}: the arm would enter it near {near} m, at joints {at}"
    return ""


def _listed(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)
