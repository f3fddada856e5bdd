"""The expected error of the tip: what a fitted model keeps of the rows that it was fitted to.

The error of the tip has two parts.  The parameters are known to their covariance, which
`Model.columns` carries to the tip at any joints: it grows away from the rows.  What no parameter
explains is structure of the arm, the same wherever the rows were and growing outside, and noise of
the measurement, which is no error of the tip.  `core/calibration/uncertainty.py` makes the record,
`core/compensation/expected.py` reads it.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist

import numpy as np

from longarm_comp.core.effects.effect import Effect

LEVEL = 0.9
"""Probability of the radius that a command states."""
YIELDS = 0.5
"""How much every part of an arm may yield, in what a soft part does, before any row is asked."""
_NORMAL = NormalDist().inv_cdf(LEVEL)
_log_gamma = np.frompyfunc(math.lgamma, 1, 1)  # SciPy loads for half a second
_Identity = tuple[object, ...]


@dataclass(frozen=True, eq=False)
class ModelUncertainty:
    """The record of what is not known of a fitted model.

    Attributes:
        slots: identities of the fitted parameters (`Slot.identity`), then those of `absent`.
        factor: (p, r), the parameters' covariance is ``factor @ factor.T``.
        structure: (3, 3) m^2, what the arm does besides and no parameter explains.
        noise: (3, 3) m^2, of the measurement: in every measured row, and no error of the tip.
        largest_m: expected error of the tip, the largest over the fitted rows, m.
        rows: number of fitted rows.
        frame: (3, 3) m^2, of where the frame of targets lies: what measures moved meanwhile.
        circumstances: lowest and highest joints, payload, temperature and tilt of these, by column.
        absent: effects that the arm may have and the model does not hold.
    """

    slots: tuple[_Identity, ...]
    factor: np.ndarray
    structure: np.ndarray
    noise: np.ndarray
    largest_m: float
    rows: int
    frame: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    circumstances: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    absent: tuple[Effect, ...] = ()

    @cached_property
    def row(self) -> dict[_Identity, int]:
        """Row of the factor by identity."""
        return {identity: k for k, identity in enumerate(self.slots)}

    def without(self, slots: Collection[_Identity]) -> ModelUncertainty:
        """Return the record of the other parameters, whatever these are."""
        kept = [k for k, identity in enumerate(self.slots) if identity not in slots]
        names = tuple(self.slots[k] for k in kept)
        return replace(self, slots=names, factor=triangular(self.factor[kept]))

    def structure_at(self, q: np.ndarray, least: np.ndarray) -> np.ndarray:
        """Return (N, 3, 3) m^2, the structure at joints (N, n), rad and m.

        Outside the range of the rows it goes on as a parabola of each joint does that has its share
        of it: the second Legendre polynomial u over the range rises from 1 to 1 + 6 (e + e^2) at e
        ranges beyond, and has a mean square of 1/5 within.

        Args:
            least: (n,) range, rad or m; of a joint that moved by less the rows tell nothing.
        """
        n = q.shape[-1]
        anywhere = (-np.inf, np.inf)
        low, high = np.array([self.circumstances.get(f"q{j + 1}", anywhere) for j in range(n)]).T
        told = high - low > least
        e = np.maximum(np.maximum(low - q, q - high), 0.0) / np.where(told, high - low, np.inf)
        grown = 1.0 + (180.0 * (e + e**2) ** 2).sum(axis=-1) / n
        return np.asarray(grown[..., None, None] * self.structure)

    def carry_to_tip(self, columns: np.ndarray, slots: Sequence[_Identity]) -> np.ndarray:
        """(N, 3, 3) m^2 that the parameters bring to the tip.

        Args:
            columns: (N, 3, k) of the tip by some parameters.
            slots: (k,) their identities. Those that were not fitted count as known.
        """
        held = [k for k, identity in enumerate(slots) if identity in self.row]
        moved = columns[..., held] @ self.factor[[self.row[slots[k]] for k in held]]
        return np.asarray(moved @ np.swapaxes(moved, -1, -2))


def sizes(covariance: np.ndarray, mean: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected length of a normal error, and what it stays below in 90 of 100 cases.

    The squared length is taken to be gamma distributed (Satterthwaite 1946, Biometrics Bull. 2),
    its cube root normal (Wilson and Hilferty 1931, PNAS 17): right to 2 % for any covariance.

    Args:
        covariance: (..., 3, 3) m^2.
        mean: (..., 3) m, of an error that is known; zero by default.

    Returns:
        (...) m each.
    """
    square = np.einsum("...ii", covariance)
    variance = 2.0 * np.einsum("...ij,...ji->...", covariance, covariance)
    if mean is not None:
        square = square + (mean**2).sum(-1)
        variance = variance + 4.0 * np.einsum("...i,...ij,...j->...", mean, covariance, mean)
    # Least variance of a squared length over its square: less changes no digit that is printed
    shape = square**2 / np.maximum(variance, 1e-9 * square**2 + 1e-300)
    shape = np.maximum(shape, 1e-300)
    rise = np.asarray(_log_gamma(shape + 0.5) - _log_gamma(shape), float)
    expected = np.sqrt(square / shape) * np.exp(rise)
    spread = variance / np.maximum(9.0 * square**2, 1e-300)
    within = np.sqrt(square * (1.0 - spread + _NORMAL * np.sqrt(spread)) ** 3)
    return np.where(square == 0, 0.0, expected), within


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """(p, p) lower triangle whose product with itself is a covariance (p, p)."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * triangular(vectors * np.sqrt(np.maximum(values, 0.0)))


def triangular(factor: np.ndarray) -> np.ndarray:
    """(p, p) lower triangle with the same product with itself as a factor (p, r)."""
    wide = np.zeros((len(factor), max(factor.shape)))
    wide[:, : factor.shape[1]] = factor
    return np.asarray(np.linalg.qr(wide.T, mode="r")).T


def encode_triangle(factor: np.ndarray) -> list[str]:
    """Write a lower triangle as text, a row a line: 32-bit numbers, little-endian, in base 64."""
    rows = factor.astype("<f4")
    return [base64.b64encode(rows[k, : k + 1].tobytes()).decode() for k in range(len(rows))]


def decode_triangle(lines: Sequence[str]) -> np.ndarray:
    """Return the (K, K) lower triangle that `encode_triangle` wrote as K lines.

    Raises:
        ValueError: the text names the first line that is wrong.
    """
    made = np.zeros((len(lines), len(lines)))
    for k, line in enumerate(lines):
        try:
            row = np.frombuffer(base64.b64decode(line, validate=True), "<f4")
        except (binascii.Error, ValueError):
            row = np.zeros(0)
        if len(row) != k + 1 or not np.isfinite(row).all():
            raise ValueError(f"line {k + 1}")
        made[k, : k + 1] = row
    return made
