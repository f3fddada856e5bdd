"""Input shaping: every joint's move is sent in parts, so that their rings cancel.

ZVD (Singer and Seering 1990): three parts half a damped period apart.  Neither a ring at that
frequency is left nor, to first order, one where the frequency is wrong.  Each joint has the
frequency that leaves least of all the modes that it drives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.core.vibration.modes import Modes, modes
from longarm_comp.math.shaper import Shaper


def zvd(omega: np.ndarray, damping: float) -> Shaper:
    """Shapers of modes of frequencies (n,) rad/s, undamped, and a share of critical damping."""
    if not 0.0 < damping < 1.0:
        raise InputError("ringing", "damping", damping, "above 0 and below 1")
    root = np.sqrt(1.0 - damping**2)
    decay = np.exp(-np.pi * damping / root)  # of a ring, in half a period
    weights = np.array([1.0, 2.0 * decay, decay**2]) / (1.0 + decay) ** 2
    return Shaper(
        np.repeat(weights[:, None], len(omega), axis=1),
        np.multiply.outer([0.0, 0.5, 1.0], 2.0 * np.pi / (omega * root)),
    )


def shaper_of(ends: Sequence[Modes], damping: float) -> Shaper | None:
    """The shaper of every joint's move between two postures; None where nothing bends.

    A move kicks the arm where it begins and where it ends. Among the modes there and the means of
    two of them, the frequency is taken that leaves least of what the joint's acceleration bends at
    the tip.
    """
    bending = [modes for modes in ends if len(modes.omega)]
    if not bending:
        return None
    pairs = combinations_with_replacement(np.concatenate([m.omega for m in bending]).tolist(), 2)
    tried = np.unique([np.sqrt(a * b) for a, b in pairs])
    sent = zvd(tried, damping)
    left = sum(left_over(sent, m.omega, damping) @ _bends(m) for m in bending)  # (tried, n)
    return zvd(tried[np.argmin(left, axis=0)], damping)


def _bends(modes: Modes) -> np.ndarray:
    """(k, n) m: how far the tip goes in each mode by a unit of each joint's acceleration."""
    return np.abs(modes.driven) * (np.linalg.norm(modes.tip, axis=1) / modes.omega**2)[:, None]


def left_over(shaper: Shaper, omega: np.ndarray, damping: float) -> np.ndarray:
    """(n, k): share of a ring that each of n shapers leaves of modes (k,) rad/s, at its end."""
    rate = -damping * omega + 1j * omega * np.sqrt(1.0 - damping**2)
    later = shaper.delays[-1] - shaper.delays
    parts = shaper.weights[..., None] * np.exp(np.multiply.outer(later, rate))
    return np.asarray(np.abs(parts.sum(axis=0)))


USUAL_DAMPING = 0.01
"""Of an arm that declares none, for the shares of a shaper: 0.05 more leave 6 % of a ring."""


def shaping(
    model: Model, names: list[str], where: str
) -> Callable[[np.ndarray, np.ndarray], Shaper | None]:
    """The shaper of a move from joints (n,) to joints (n,), in the order of their names.

    Raises:
        InputError: names ``where``: a joint of the arm is not among the names.
    """
    arm = model.arm
    for name in arm.joint_names:
        if name not in names:
            raise InputError(where, f"servo of {name}", "missing", ", ".join(names))
    order = [names.index(name) for name in arm.joint_names]
    damping = arm.damping or USUAL_DAMPING

    def of(start: np.ndarray, end: np.ndarray) -> Shaper | None:
        made = shaper_of([modes(model, q[order]) for q in (start, end)], damping)
        if made is None:
            return None
        weights, delays = np.zeros((2, 3, len(names)))
        weights[0] = 1.0  # a servo beside the arm goes as it is sent
        weights[:, order], delays[:, order] = made.weights, made.delays
        return Shaper(weights, delays)

    return of
