"""Whether a move enters a box that the arm must keep out of."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.model.link_frames import outline
from longarm_comp.core.model.model import Model


def entered(model: Model, path: np.ndarray) -> str:
    """Which box a move enters, where, and at which joints; empty if it enters none.

    The arm is the line through its stations, from the foot to the tip: a box must be larger than
    the thing that it protects by the arm's radius. Between way-points joints move straight.
    """
    # Postures looked at from one way-point to the next
    shares = np.linspace(0.0, 1.0, 16 + 1)[1:, None]
    for start, end in pairwise(path) if model.arm.keep_out else ():
        if found := entered_at(model, start + shares * (end - start)):
            return found
    return ""


def entered_at(model: Model, q: np.ndarray) -> str:
    """As `entered`, for postures (M, n) on the way."""
    for joints, found in zip(q.tolist(), boxes_entered(model, q), strict=True):
        if found:
            at = ", ".join(f"{number:.3g}" for number in joints)
            return f"keep_out {found}, at joints {at}"
    return ""


def keeper(model: Model, names: list[str], where: str) -> Callable[[np.ndarray], str] | None:
    """`entered_at` for joints (M, n) in the order of their names; None where there are no boxes."""
    arm = model.arm
    if not arm.keep_out:
        return None
    for name in arm.joint_names:
        if name not in names:
            raise InputError(where, f"servo of {name}", "missing", ", ".join(names))
    order = [names.index(name) for name in arm.joint_names]
    return lambda q: entered_at(model, q[:, order])


def boxes_entered(model: Model, q: np.ndarray) -> list[str]:
    """For each of the postures q (M, n): the box of arm.yaml that the arm is in, and where.

    A box that the arm's foot stands in, as a floor above the foot, is left once: what comes after
    must stay out, and so must the tip.
    """
    lines = outline(model, q)
    found = [""] * len(q)
    for name, box in model.arm.keep_out.items():
        parts = box.crossed(lines)
        below = np.logical_and.accumulate(box.holds(lines), axis=-1)
        parts &= ~below[:, :-1] | below[:, -1:]
        for k in np.flatnonzero(parts.any(axis=-1)):
            near = ", ".join(f"{number:.3g}" for number in lines[k, np.argmax(parts[k]) + 1])
            found[k] = found[k] or f"{name}: the arm would enter it near {near} m"
    return found
