"""Input shaping: every joint's move is sent in parts, so that their rings cancel.

ZVD (Singer and Seering 1990): three parts half a damped period apart.  Neither a ring at that
frequency is left nor, to first order, one where the frequency is wrong.  Each joint has the
frequency that leaves least of all the modes that it drives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.vibration.modes import Modes

Way = Callable[[np.ndarray], np.ndarray]
"""Joints (M, n) at times (M,)."""


@dataclass(frozen=True, eq=False)
class Shaper:
    """Parts of every joint's move: shares (3, n), which add up to 1, and delays (3, n) in s."""

    weights: np.ndarray
    delays: np.ndarray

    @property
    def duration(self) -> float:
        """By how much a move takes longer, s."""
        return float(self.delays.max(initial=0.0))

    def shaped(self, way: Way) -> Way:
        """A motion in parts; ``way`` has to stand still before its time 0."""

        def at(times: np.ndarray) -> np.ndarray:
            whole = np.zeros((len(times), self.weights.shape[1]))
            for weights, delays in zip(self.weights, self.delays, strict=True):
                for joint, (share, late) in enumerate(zip(weights, delays, strict=True)):
                    whole[:, joint] += share * way(np.maximum(times - late, 0.0))[:, joint]
            return whole

        return at


def zvd(omega: np.ndarray, damping: float) -> Shaper:
    """Shapers of modes of frequencies (n,) rad/s, undamped, and a share of critical damping.

    Raises:
        InputError: the damping is not above 0 and below 1.
    """
    if not 0.0 < damping < 1.0:
        raise InputError("ringing", "damping", damping, "above 0 and below 1")
    root = np.sqrt(1.0 - damping**2)
    decay = np.exp(-np.pi * damping / root)  # of a ring, in half a period
    weights = np.array([1.0, 2.0 * decay, decay**2]) / (1.0 + decay) ** 2
    return Shaper(
        np.repeat(weights[:, None], len(omega), axis=1),
        np.multiply.outer([0.0, 0.5, 1.0], 2.0 * np.pi / (omega * root)),
    )


def shaper_of(modes: Modes, damping: float) -> Shaper | None:
    """The shaper of every joint at a posture; None where nothing bends.

    Among the modes and the means of two of them, the frequency is taken that leaves least of what
    the joint's acceleration bends at the tip.
    """
    if not len(modes.omega):
        return None
    pairs = combinations_with_replacement(modes.omega.tolist(), 2)
    tried = np.array([np.sqrt(a * b) for a, b in pairs])
    bends = np.abs(modes.driven) * (np.linalg.norm(modes.tip, axis=1) / modes.omega**2)[:, None]
    left = left_over(zvd(tried, damping), modes.omega, damping) @ bends  # (tried, n)
    return zvd(tried[np.argmin(left, axis=0)], damping)


def left_over(shaper: Shaper, omega: np.ndarray, damping: float) -> np.ndarray:
    """(n, k): share of a ring that each of n shapers leaves of modes (k,) rad/s, at its end."""
    rate = -damping * omega + 1j * omega * np.sqrt(1.0 - damping**2)
    later = shaper.delays[-1] - shaper.delays
    parts = shaper.weights[..., None] * np.exp(np.multiply.outer(later, rate))
    return np.asarray(np.abs(parts.sum(axis=0)))
