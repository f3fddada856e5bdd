"""The learned residual: an ensemble of BP networks with uncertainty and a training domain.

``error = measured - predicted`` (m), so a prediction is subtracted from the target. ``sigma`` is
the standard deviation of a new measurement around the prediction: spread of the ensemble, Laplace
posterior of its likeliest member and noise, scaled so that 90 % intervals (``+-1.645 sigma``) hold
on rows left out of the training, four parts in turn (cross-conformal; Vovk 2015, Ann. Math. Artif.
Intell. 74). Linearised leave-one-out residuals are too small by a third where noise is learned.

Outside the training region the predictor refuses: ``in_domain`` is False and ``reason`` says why.
So it does where ``sigma`` says that its prediction leaves no less than the physics alone left over
the training rows (``alone``, by the same 90 % intervals): between the levels of a coarse grid a
network may know nothing. And everywhere, where the rows left out do not show a ``gain`` beyond
chance: a network that learned noise adds it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expansion import LINEAR_M, Expansion
from longarm_comp.core.compensation.result import Prediction
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.inputs import Encoding, check_rows, raw_names
from longarm_comp.core.learn.network import NetworkShape, TanhMembers

if TYPE_CHECKING:
    from longarm_comp.core.learn.others import NetworkKind, TorchMembers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LearnedGain:
    """What a network brought on rows that were left out of its training, lengths in m."""

    without: float = math.inf  # mean error that the physics alone leaves
    left: float = 0.0  # with the network
    low: float = math.inf  # lower end of the gain, 95 % one-sided

    @classmethod
    def of(cls, residual: Array, left: Array) -> LearnedGain:
        """From the residual (N, 3) and what the network leaves of it, row by row."""
        before, after = (np.linalg.norm(e, axis=1) for e in (residual, left))
        gained = before - after
        chance = 1.6449 * gained.std(ddof=1) / math.sqrt(len(gained))
        return cls(float(before.mean()), float(after.mean()), float(gained.mean() - chance))

    @property
    def helps(self) -> bool:
        """Whether the error falls beyond chance."""
        return self.low > 0.0

    def __str__(self) -> str:
        return (
            f"at poses left out of its training the network leaves {1e3 * self.left:.3f} mm, "
            f"the physics alone {1e3 * self.without:.3f} mm"
        )


@dataclass(frozen=True)
class Provenance:
    """Arm, session and settings that the predictor was trained with."""

    arm_hash: str = ""
    session_hash: str = ""
    joint_names: tuple[str, ...] = ()
    settings: Mapping[str, object] = field(default_factory=dict)

    @property
    def beside_deflection(self) -> bool:
        """Whether it learned the residual of the physics with link deflection."""
        return bool(self.settings.get("deflection", True))


@dataclass(frozen=True)
class Predictor:
    """A trained ensemble; ``train`` makes one, ``load`` reads one."""

    encoding: Encoding
    lower: Array  # (columns,) training range of every raw column
    upper: Array
    weights: Array  # (M, D), standardised units
    hidden: int  # of the largest member; smaller ones have idle units; 0 of a network of others
    posterior: NDArray[np.float32]  # (r, D) covariance C ~ P'P of the first member, the likeliest
    offset: Array  # (3,) m, subtracted from the residual before scaling
    scale: float  # m, one for the three axes
    noise: Array  # (3,) m
    widen: Array  # (3,) conformal factor
    variance_limit: float  # m^2, largest epistemic variance still trusted
    alone: Array = field(default_factory=lambda: np.full(3, np.inf))  # (3,) m, sigma without it
    gain: LearnedGain = field(default_factory=LearnedGain)
    provenance: Provenance = field(default_factory=Provenance)
    network: NetworkKind | None = None  # None: the paper's, which needs no torch

    @cached_property
    def members(self) -> TanhMembers | TorchMembers:
        inputs, outputs = len(self.encoding.kept), len(self.offset)
        if self.network is not None:
            return self.network.members(inputs, outputs, self.weights)
        return TanhMembers(NetworkShape(inputs, self.hidden, outputs), self.weights)

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper (columns,) of the training region, margins included."""
        # of a context column's training range; it has less influence, and drifts
        margin = np.full(len(self.lower), 0.5)
        # of a joint's training range
        margin[: self.encoding.joints] = 0.02
        width = margin * (self.upper - self.lower) + 1e-6
        return self.lower - width, self.upper + width

    def predict(self, q: Array, context: Context | None = None) -> Prediction:
        """Expected residual at joints (N, n), rad and m.

        Context that is absent or NaN is replaced by its training mean, and ``sigma`` is widened by
        its influence.
        """
        q, known = check_rows("predict", q, context)
        if q.shape[1] != self.encoding.joints:
            raise InputError("predict", "q", f"{q.shape[1]} joints", f"{self.encoding.joints}")
        raw = self.encoding.raw(q, known)
        x = self.encoding.standardise(raw)
        error, epistemic = self._mean_and_variance(x)
        if np.isnan(raw).any():
            epistemic = epistemic + self._unknown_context(raw, x)
        sigma = self.widen * np.sqrt(epistemic + self.noise**2)
        largest = epistemic.max(axis=1)
        inside, outside, reason = self._domain(raw, largest, sigma)
        return Prediction(error, sigma, inside, reason, largest / self.variance_limit, outside)

    def _mean_and_variance(self, x: Array) -> tuple[Array, Array]:
        """Mean (N, 3) and epistemic variance (N, 3) in m, m^2 for standardised inputs (N, d)."""
        outputs = self.members.outputs(x)
        mean = outputs.sum(axis=0) / len(outputs)
        variance = ((outputs - mean) ** 2).sum(axis=0) / max(1, len(outputs) - 1)
        for start in range(0, len(x), 1024):
            rows = slice(start, start + 1024)
            jacobian = self.members.jacobian(x[rows])
            flat = jacobian.reshape(-1, jacobian.shape[2]).astype(np.float32)
            spread = flat @ self.posterior.T
            laplace = np.einsum("ij,ij->i", spread, spread)
            variance[rows] += laplace.reshape(-1, len(self.offset))
        return mean * self.scale + self.offset, variance * self.scale**2

    def _unknown_context(self, raw: Array, x: Array) -> Array:
        """Variance (N, 3) in m^2 of unknown context: the effect of one training sd, summed over
        the columns."""
        unknown = np.isnan(raw[:, self.encoding.kept])
        variance = np.zeros((len(x), len(self.offset)))
        for column in np.flatnonzero(unknown.any(axis=0)):
            step = np.zeros_like(x)
            step[:, column] = unknown[:, column]
            up, down = (self.members.outputs(moved).mean(axis=0) for moved in (x + step, x - step))
            variance += (0.5 * self.scale * (up - down)) ** 2
        return variance

    def _domain(
        self, raw: Array, variance: Array, sigma: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], list[str]]:
        low, high = self.box
        outside = (raw < low) | (raw > high)  # NaN, not known, is neither
        unsure = variance > self.variance_limit
        without = float(np.linalg.norm(self.alone))
        left = np.linalg.norm(sigma, axis=1)
        useless = left >= without
        unproven = np.full(len(raw), not self.gain.helps)
        away = unsure | outside.any(axis=1)
        bad = away | useless | unproven
        reason = [""] * len(raw)
        names = raw_names(self.encoding.joints, self.encoding.context)
        for row in np.flatnonzero(bad):
            parts = [
                f"{names[c]} = {raw[row, c]:.4g} outside the training range "
                f"[{self.lower[c]:.4g}, {self.upper[c]:.4g}]"
                for c in np.flatnonzero(outside[row])
            ]
            if unsure[row]:
                parts.append(
                    f"uncertainty {1e3 * variance[row] ** 0.5:.2f} mm above the limit "
                    f"{1e3 * self.variance_limit**0.5:.2f} mm"
                )
            if useless[row]:
                parts.append(
                    f"sigma {1e3 * left[row]:.2f} mm is not below the {1e3 * without:.2f} mm that "
                    "the physics alone leaves"
                )
            if unproven[row]:
                parts.append(str(self.gain))
            reason[row] = "; ".join(parts)
        return ~bad, away, reason


class Expander:
    """Computes expansions of one predictor."""

    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor
        encoding = predictor.encoding
        self._joint = encoding.kept < encoding.joints  # columns that are a joint
        self._moved = encoding.kept[self._joint]
        self._width = encoding.scale[self._joint]

    def __call__(self, q: np.ndarray, context: Context | None = None) -> Expansion:
        """Predict at joints (n,) and around them."""
        predictor, n = self._predictor, len(q)
        context = context or Context()
        found = predictor.predict(q[None], context)
        x = predictor.encoding.standardise(predictor.encoding.raw(q[None], context))[0]
        slope, step = predictor.members.slope(x, self._joint, LINEAR_M / predictor.scale)
        jacobian, reach = np.zeros((3, n)), np.zeros(n)
        jacobian[:, self._moved] = predictor.scale * slope / self._width
        # allowed growth of the variance, up to the limit of the domain
        if found.in_domain[0] and found.doubt[0] * 1.5 <= 1.0:
            # of a column's training sd; epistemic variance grows by a quarter at the most
            step = min(0.05, step)
            low, high = predictor.box
            reach = np.minimum(q - low[:n], high[:n] - q)
            reach[self._moved] = np.minimum(reach[self._moved], step * self._width)
        return Expansion(
            found.error[0], found.sigma[0], bool(found.in_domain[0]), found.reason[0],
            jacobian, reach,
        )  # fmt: skip
