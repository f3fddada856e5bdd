"""Other explanations of a model's rows, and the length of an error that one of them may cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.effect import Effect

HALVINGS = 30
"""Number of bisections of a length: to nine digits."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """An explanation that may be true instead of the model's.

    Attributes:
        chance: its probability. The model has what all alternatives leave.
        slots: (p,) identities of parameters (`Slot.identity`).
        moves: (1 + k, p) first their values in a fit with this explanation, less those in the
            model.  Then, for each parameter of its own, what one standard deviation of it moves.
        terms: its effects that the model does not hold.
    """

    chance: float
    slots: tuple[tuple[object, ...], ...]
    moves: np.ndarray
    terms: tuple[Effect, ...] = ()

    def moves_of(self, slots: Sequence[tuple[object, ...]]) -> np.ndarray:
        """Return the moves (1 + k, K) of some parameters; 0 for those that it does not move."""
        at = {identity: k for k, identity in enumerate(self.slots)}
        found = [self.moves[:, at[s]] if s in at else np.zeros(len(self.moves)) for s in slots]
        return np.stack(found, axis=1) if found else np.zeros((len(self.moves), 0))


def list_told(alternatives: Sequence[Alternative], context: Context) -> tuple[Alternative, ...]:
    """Return the alternatives whose effects need no circumstance that a context lacks."""
    return tuple(a for a in alternatives if not any(t.missing(context) for t in a.terms))


def mixture_quantile(
    level: float, chance: np.ndarray, square: np.ndarray, spread: np.ndarray, within: np.ndarray
) -> np.ndarray:
    """Return the length (...) that an error of one of A distributions stays below.

    The cube root of each squared length, over its mean, is normal (`uncertainty.sizes`).

    Args:
        level: the probability to stay below.
        chance: (A,) probability of each distribution; the sum is 1.
        square: (A, ...) mean of the squared length.
        spread: (A, ...) variance of the cube root.
        within: (A, ...) the length that each stays below.
    """
    low, high = within.min(axis=0), within.max(axis=0)
    sd = np.sqrt(np.maximum(spread, 1e-12))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        root = np.cbrt(middle**2 / np.maximum(square, 1e-300))
        below = np.tensordot(chance, _normal_cdf((root - 1.0 + spread) / sd), axes=1) < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(high)


def _normal_cdf(z: np.ndarray) -> np.ndarray:
    """Return the normal distribution function, right to 2e-4 (Page 1977, Appl. Stat. 26)."""
    z = np.clip(z, -6.0, 6.0)
    return np.asarray(1.0 / (1.0 + np.exp(-1.5976 * z - 0.07056 * z**3)))
