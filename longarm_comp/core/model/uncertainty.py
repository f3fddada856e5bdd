"""The uncertainty of a fitted model, from which the expected error of the tip is computed.

The error of the tip has two parts.  The first is that of the parameters: `Model.columns` carries
their covariance to the tip at any joints, and it grows away from the fitted rows.  The second is
structure that no parameter explains: it grows with the distance from the rows (`domain.py`).  Noise
of the measurement is no error of the tip.  `core/calibration/uncertainty.py` estimates all of them,
`core/compensation/expected.py` uses them.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.model.domain import RowDomain

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


LEVEL = 0.9
"""Probability that the tip is within the radius that a command states."""
YIELDS = 0.5
"""Prior of any part's compliance before a measurement, as a share of the prior of a soft part."""
_NORMAL = NormalDist().inv_cdf(LEVEL)
_log_gamma = np.frompyfunc(math.lgamma, 1, 1)  # SciPy loads for half a second
_Identity = tuple[object, ...]


@dataclass(frozen=True, eq=False)
class ModelUncertainty:
    """The uncertainty of a fitted model.

    Attributes:
        slots: identities of the fitted parameters (`Slot.identity`), then those of `absent`.
        factor: (p, r), the parameters' covariance is ``factor @ factor.T``.
        structure: (3, 3) covariance of the tip's error that no parameter explains, m^2, amid the
            rows.
        noise: (3, 3) covariance of the measurement's noise, m^2; it is no error of the tip.
        largest_m: expected error of the tip, the largest over the fitted rows, m.
        rows: number of fitted rows.
        frame: (3, 3) covariance of the position of the targets' frame, m^2: the sensor may have
            moved during the session.
        circumstances: lowest and highest value in the fitted rows, by column: joints (``q1``, ...),
            payload, temperature and tilt.
        absent: effects that the arm may have and the model does not hold.
        domain: where the rows stood; None if a file of an earlier version does not say it.
        alternatives: other explanations of the rows, with their probabilities.
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
    domain: RowDomain | None = None
    alternatives: tuple[Alternative, ...] = ()

    @cached_property
    def row(self) -> dict[_Identity, int]:
        """The row of `factor` by a parameter's identity."""
        return {identity: k for k, identity in enumerate(self.slots)}

    def without(self, slots: Collection[_Identity]) -> ModelUncertainty:
        """Return the uncertainty of the other parameters, with the given ones marginalised out."""
        kept = [k for k, identity in enumerate(self.slots) if identity not in slots]
        names = tuple(self.slots[k] for k in kept)
        return replace(self, slots=names, factor=triangular(self.factor[kept]))

    def structure_at(self, q: np.ndarray, least: np.ndarray) -> np.ndarray:
        """Return the covariance of the structure at joints (N, n), rad and m: (N, 3, 3), m^2.

        It grows with the distance from the rows.  Outside their range it also grows as if each
        joint caused an equal share of it by a parabola.  The second Legendre polynomial over the
        range rises from 1 to 1 + 6 (e + e^2) at e ranges beyond it, and has a mean square of 1/5
        within it.

        Args:
            least: (n,) rad or m; a joint whose range in the rows is not larger adds no growth.
        """
        n = q.shape[-1]
        anywhere = (-np.inf, np.inf)
        low, high = np.array([self.circumstances.get(f"q{j + 1}", anywhere) for j in range(n)]).T
        told = high - low > least
        e = np.maximum(np.maximum(low - q, q - high), 0.0) / np.where(told, high - low, np.inf)
        near = 1.0 if self.domain is None else self.domain.growth_at(q)
        grown = near + (180.0 * (e + e**2) ** 2).sum(axis=-1) / n
        return np.asarray(grown[..., None, None] * self.structure)

    def carry_to_tip(self, columns: np.ndarray, slots: Sequence[_Identity]) -> np.ndarray:
        """Return the covariance of the tip due to the parameters, (N, 3, 3), m^2.

        Args:
            columns: (N, 3, k) derivatives of the tip by some parameters.
            slots: (k,) their identities. Those that were not fitted count as known.
        """
        held = [k for k, identity in enumerate(slots) if identity in self.row]
        moved = columns[..., held] @ self.factor[[self.row[slots[k]] for k in held]]
        return np.asarray(moved @ np.swapaxes(moved, -1, -2))


def sizes(
    covariance: np.ndarray, mean: np.ndarray | None = None, chance: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected length of a normally distributed error, and the length's 90 % quantile.

    The squared length is taken to be gamma distributed (Satterthwaite 1946, Biometrics Bull. 2),
    its cube root normal (Wilson and Hilferty 1931, PNAS 17): right to 2 % for any covariance.

    Args:
        covariance: (..., 3, 3) m^2.
        mean: (..., 3) m, mean of the error; zero by default.
        chance: (A,) probability of each of A means (A, ..., 3), one of which is true.

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
    if chance is not None:
        expected = np.tensordot(chance, expected, axes=1)
        return expected, mixture_quantile(LEVEL, chance, square, spread, within)
    return np.where(square == 0, 0.0, expected), within


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """Return the lower triangle L (p, p) for which ``L L'`` is a covariance (p, p)."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * triangular(vectors * np.sqrt(np.maximum(values, 0.0)))


def triangular(factor: np.ndarray) -> np.ndarray:
    """Return the lower triangle L (p, p) for which ``L L'`` is ``F F'`` of a factor F (p, r)."""
    wide = np.zeros((len(factor), max(factor.shape)))
    wide[:, : factor.shape[1]] = factor
    return np.asarray(np.linalg.qr(wide.T, mode="r")).T


def encode_numbers(numbers: np.ndarray) -> str:
    """Return numbers (k,) as text: 32-bit floats, little-endian, in base 64."""
    return base64.b64encode(numbers.astype("<f4").tobytes()).decode()


def decode_numbers(text: str) -> np.ndarray:
    """Return the numbers (k,) that `encode_numbers` wrote.

    Raises:
        ValueError: the text is no base 64 of finite 32-bit numbers.
    """
    numbers = np.frombuffer(base64.b64decode(text, validate=True), "<f4").astype(float)
    if not np.isfinite(numbers).all():
        raise ValueError("not finite")
    return numbers


def encode_triangle(factor: np.ndarray) -> list[str]:
    """Return a lower triangle as text, one line a row."""
    return [encode_numbers(row[: k + 1]) for k, row in enumerate(factor)]


def decode_triangle(lines: Sequence[str]) -> np.ndarray:
    """Return the (K, K) lower triangle that `encode_triangle` wrote as K lines.

    Raises:
        ValueError: the text names the first line that is wrong.
    """
    made = np.zeros((len(lines), len(lines)))
    for k, line in enumerate(lines):
        try:
            row = decode_numbers(line)
        except ValueError:
            row = np.zeros(0)
        if len(row) != k + 1:
            raise ValueError(f"line {k + 1}")
        made[k, : k + 1] = row
    return made
