"""The learned residual: an ensemble of BP networks with uncertainty and a training domain.

``error = measured - predicted`` (m), so a prediction is subtracted from the target. ``sigma`` is
the standard deviation of a new measurement around the prediction: spread of the ensemble, Laplace
posterior of its likeliest member and noise, scaled so that 90 % intervals (``+-1.645 sigma``) hold
on rows left out of the training, four parts in turn (cross-conformal; Vovk 2015, Ann. Math. Artif.
Intell. 74). Linearised leave-one-out residuals, the alternative, are too small by a third where
noise is learned.

Outside the training region the predictor refuses: ``in_domain`` is False and ``reason`` says why.
It also refuses where ``sigma`` is not below the error that the physics alone leaves over the
training rows (``alone``, by the same 90 % intervals): between the levels of a coarse grid a network
may know nothing. It refuses everywhere if the rows left out show no ``gain`` beyond chance: a
network that learned noise adds it.
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
from longarm_comp.core.learn.inputs import Encoding, check_rows
from longarm_comp.core.learn.network import NetworkShape, TanhMembers
from longarm_comp.math.points import lengths

if TYPE_CHECKING:
    from longarm_comp.core.learn.others import NetworkKind, TorchMembers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LearnedGain:
    """The gain by a network on rows that were left out of its training, lengths in m."""

    without: float = math.inf  # mean error that the physics alone leaves
    left: float = 0.0  # with the network
    low: float = math.inf  # lower end of the gain, 95 % one-sided

    @classmethod
    def of(cls, residual: Array, left: Array) -> LearnedGain:
        """Estimate the gain from the physics' residual and what is left of it, (N, 3) m each."""
        before, after = (np.linalg.norm(e, axis=1) for e in (residual, left))
        gained = before - after
        chance = 1.6449 * gained.std(ddof=1) / math.sqrt(len(gained))
        return cls(float(before.mean()), float(after.mean()), float(gained.mean() - chance))

    @property
    def helps(self) -> bool:
        """True if the error falls beyond chance."""
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
        """True if it learned the residual of a model with link deflection."""
        return bool(self.settings.get("deflection", True))


@dataclass(frozen=True)
class Predictor:
    """A trained ensemble; ``train`` makes one, ``load`` reads one."""

    encoding: Encoding
    weights: Array  # (M, D), standardised units
    hidden: int  # of the largest member (smaller ones have idle units); 0: a foreign network
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

    def predict(self, q: Array, context: Context | None = None) -> Prediction:
        """Predict the residual at joints (N, n), rad and m.

        A circumstance that is missing or NaN is replaced by its training mean, and ``sigma`` is
        widened by its influence.
        """
        return self._predict(q, context)[0]

    def _predict(self, q: Array, context: Context | None) -> tuple[Prediction, Array]:
        """Return the prediction at joints (N, n), and the standardised inputs (N, d)."""
        q, known = check_rows("predict", q, context)
        if q.shape[1] != self.encoding.joints:
            raise InputError("predict", "q", f"{q.shape[1]} joints", f"{self.encoding.joints}")
        raw, x = self.encoding.encode(q, known)
        error, epistemic = self.mean_and_variance(x)
        epistemic += self._unknown_context(raw, x)
        sigma, largest = self.widen * np.sqrt(epistemic + self.noise**2), epistemic.max(axis=1)
        low, high = self.encoding.box
        outside = (raw < low) | (raw > high)  # NaN, not known, is neither
        unsure = largest > self.variance_limit
        useless = lengths(sigma) >= lengths(self.alone)
        away = unsure | outside.any(axis=1)
        inside = ~(away | useless) & self.gain.helps
        reason = [""] * len(q)
        for row in np.flatnonzero(~inside):
            reason[row] = self._reason(raw[row], outside[row], largest[row], sigma[row])
        found = Prediction(error, sigma, inside, reason, largest / self.variance_limit, away)
        return found, x

    def mean_and_variance(self, x: Array) -> tuple[Array, Array]:
        """Return mean and epistemic variance, (N, 3) m and m^2, at standardised inputs (N, d)."""
        outputs = self.members.outputs(x)
        mean = outputs.sum(axis=0) / len(outputs)
        variance = ((outputs - mean) ** 2).sum(axis=0) / max(1, len(outputs) - 1)
        for start in range(0, len(x), 1024):
            rows = slice(start, start + 1024)
            jacobian = self.members.jacobian(x[rows]).reshape(-1, self.posterior.shape[1])
            spread = jacobian.astype(np.float32) @ self.posterior.T
            variance[rows] += np.einsum("ij,ij->i", spread, spread).reshape(-1, len(self.offset))
        return mean * self.scale + self.offset, variance * self.scale**2

    def _unknown_context(self, raw: Array, x: Array) -> Array:
        """Return the variance (N, 3), m^2, that unknown circumstances add.

        Each adds the squared effect of one standard deviation of the training data.
        """
        unknown = np.isnan(raw[:, self.encoding.kept])
        variance = np.zeros((len(x), len(self.offset)))
        for column in np.flatnonzero(unknown.any(axis=0)):
            step = np.zeros_like(x)
            step[:, column] = unknown[:, column]
            up, down = (self.members.outputs(moved).mean(axis=0) for moved in (x + step, x - step))
            variance += (0.5 * self.scale * (up - down)) ** 2
        return variance

    def _reason(self, raw: Array, outside: NDArray[np.bool_], variance: float, sigma: Array) -> str:
        encoding = self.encoding
        parts = [
            f"{encoding.columns[c]} = {raw[c]:.4g} outside the training range "
            f"[{encoding.lower[c]:.4g}, {encoding.upper[c]:.4g}]"
            for c in np.flatnonzero(outside)
        ]
        if variance > self.variance_limit:
            found, limit = (1e3 * each**0.5 for each in (variance, self.variance_limit))
            parts.append(f"uncertainty {found:.2f} mm above the limit {limit:.2f} mm")
        left, without = (1e3 * float(np.linalg.norm(each)) for each in (sigma, self.alone))
        if left >= without:
            parts.append(
                f"sigma {left:.2f} mm is not below the {without:.2f} mm that the physics alone "
                "leaves"
            )
        if not self.gain.helps:
            parts.append(str(self.gain))
        return "; ".join(parts)

    def expand(self, q: Array, context: Context | None = None) -> Expansion:
        """Return the prediction at joints (n,), rad and m, with its slope by the joints."""
        encoding = self.encoding
        found, x = self._predict(q[None], context)
        slope, step = self.members.slope(x[0], encoding.is_joint, LINEAR_M / self.scale)
        moved, width = encoding.kept[encoding.is_joint], encoding.scale[encoding.is_joint]
        jacobian, reach = np.zeros((3, len(q))), np.zeros(len(q))
        jacobian[:, moved] = self.scale * slope / width
        # allowed growth of the variance, up to the limit of the domain
        if found.in_domain[0] and found.doubt[0] * 1.5 <= 1.0:
            low, high = (each[: len(q)] for each in encoding.box)
            reach = np.minimum(q - low, high - q)
            # of a column's training sd; epistemic variance grows by a quarter at the most
            reach[moved] = np.minimum(reach[moved], min(0.05, step) * width)
        inside = bool(found.in_domain[0])
        return Expansion(found.error[0], found.sigma[0], inside, found.reason[0], jacobian, reach)
