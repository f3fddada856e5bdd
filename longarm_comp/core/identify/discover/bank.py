"""Every component times every function, scored at once on top of a fit.

A candidate's column is the motion of the channels by a unit of a component, row by row times a
function of the inputs.  Its products with the geometry's columns and with the residual are
therefore matrix products, and the evidence of some hundred thousand candidates takes a second.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.effects.function import Function
from longarm_comp.core.effects.shapes import Threshold, Wave
from longarm_comp.core.identify.discover.functions import (
    FunctionFamily,
    FunctionGroup,
    Functions,
    nearby,
)
from longarm_comp.core.identify.discover.score import many
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.model_fit import ModelFit, priors

RARE = 3.0
"""Log odds against a quantity that a cause is not likely to depend on."""


@dataclass(frozen=True)
class Spot:
    """Where, and which component: of the arm a place and a twist or load, of the camera an axis."""

    at: str
    component: str

    @property
    def kind(self) -> tuple[str, str]:
        """Spot and word of the component, without its axis."""
        return self.at, self.component.split(" ")[0]


@dataclass(frozen=True)
class Hypothesis:
    """Columns that are fitted together.

    Attributes:
        members: place and function of each column.
        decay: prior of each, against the first.
        family: kind of function.
        log_prior: of the choice among all candidates.
    """

    members: tuple[tuple[Spot, Function], ...]
    decay: tuple[float, ...]
    family: FunctionFamily
    log_prior: float

    @property
    def functions(self) -> tuple[Function, ...]:
        """The functions, each once."""
        return tuple(dict.fromkeys(f for _, f in self.members))


@dataclass(frozen=True)
class Weighed:
    """A candidate and its evidence.

    Attributes:
        candidate: the columns.
        log_evidence: log Bayes factor averaged over amplitudes, with the prior of the choice.
        mean: (r,) amounts, SI; scale: (r,) their prior standard deviations at the best amplitude.
    """

    candidate: Hypothesis
    log_evidence: float
    mean: np.ndarray
    scale: np.ndarray


class Bank:
    """All candidates of one side: components times functions.

    Args:
        places: K components.
        units: (N, d, K) motion of the channels by a unit of each, m or rad.
        functions: G functions at the N rows.
        axes: by commanded joint (0-based), the place that moves it along its own axis.
    """

    def __init__(
        self,
        places: Sequence[Spot],
        units: np.ndarray,
        functions: Functions,
        axes: Sequence[Spot] = (),
    ) -> None:
        self.places, self.units, self.functions = tuple(places), units, functions
        self._number = {place: k for k, place in enumerate(self.places)}
        kinds: dict[tuple[str, str], list[int]] = {}
        for k, place in enumerate(self.places):
            kinds.setdefault(place.kind, []).append(k)
        self.vectors = [ks for ks in kinds.values() if len(ks) == 3]
        self.axes = [self._number[place] for place in axes]
        self.priors = self._priors()

    def _priors(self) -> dict[FunctionFamily, float]:
        """Log prior of a candidate of each kind of function; half for single components."""
        counts: dict[FunctionFamily, int] = {}
        for group in self.functions.groups:
            counts[group.family] = counts.get(group.family, 0) + 1
        return {f: math.log(f.share / (2.0 * n * len(self.places))) for f, n in counts.items()}

    def prior(self, group: FunctionGroup) -> float:
        """Log prior of a group of functions at one component."""
        return self.priors[group.family] - RARE * group.rare

    def columns(self, members: Sequence[tuple[Spot, Function]]) -> np.ndarray:
        """(N, d, r) columns per unit."""
        made = [
            self.units[:, :, self._number[p]] * self.functions.of(f)[:, None] for p, f in members
        ]
        return np.stack(made, axis=-1)

    def score(self, marginal: Marginal, fit: ModelFit, candidate: Hypothesis) -> Weighed:
        """Exact evidence of a candidate on top of a marginal, on all rows."""
        columns = self.columns(candidate.members)
        flat = (columns * weight(fit)[..., None])[fit.weights > 0].reshape(-1, columns.shape[-1])
        return scored(marginal, flat, candidate)


def scored(marginal: Marginal, flat: np.ndarray, candidate: Hypothesis) -> Weighed:
    """Evidence of whitened columns (m, r), and their amounts."""
    rows = len(flat) / 3.0
    size = np.sqrt(np.maximum((flat**2).sum(0) / rows, 1e-300))
    unit = flat * (np.array(candidate.decay) / size)
    projected = marginal.project(unit)
    t, s = unit.T @ marginal.py, unit.T @ projected
    evidence, amplitude = many(t[None], s[None])
    a = float(amplitude[0])
    mean = a * np.linalg.solve(np.eye(len(t)) + a * a * (s + s.T) / 2, a * t)
    per = np.array(candidate.decay) / size
    return Weighed(candidate, float(evidence[0]) + candidate.log_prior, mean * per, a * per)


def weight(fit: ModelFit) -> np.ndarray:
    """(N, d) one over the noise where a row counts and holds a channel, else 0."""
    held = np.isfinite(fit.sigma) & fit.session.measured
    return np.where(held, np.sqrt(fit.weights)[:, None] / fit.sigma, 0.0)


def whitened_design(fit: ModelFit) -> np.ndarray:
    """(N, d, p) columns of a fit, prior-scaled and over the noise."""
    return fit.columns * priors(fit.slots) * weight(fit)[..., None]


def flattened(design: np.ndarray) -> np.ndarray:
    """(N d, p) of (N, d, p), where a model has no free parameter too."""
    return design.reshape(design.shape[0] * design.shape[1], design.shape[2])


def around(bank: Bank, candidate: Hypothesis, width: float) -> Iterator[Hypothesis]:
    """The same candidate with thresholds or frequencies near its own."""
    factors = dict.fromkeys(f for function in candidate.functions for f in function.factors)
    bent = [f for f in factors if isinstance(f, (Threshold, Wave))]
    by_name = bank.functions.inputs.by_name
    if len(bent) == 1:
        for other in nearby(bent[0], by_name[bent[0].of], width):
            yield _renamed(candidate, {bent[0]: other})
    elif len(bent) == 2 and all(isinstance(f, Wave) for f in bent):
        first, second = (nearby(f, by_name[f.of], width) for f in bent)
        for pair in zip(first, second, strict=True):
            yield _renamed(candidate, dict(zip(bent, pair, strict=True)))


def _renamed(candidate: Hypothesis, other: dict) -> Hypothesis:
    members = tuple(
        (place, Function(tuple(other.get(f, f) for f in function.factors)))
        for place, function in candidate.members
    )
    return dataclasses.replace(candidate, members=members)


def marginal_of(fit: ModelFit, kept: np.ndarray) -> tuple[Marginal, np.ndarray]:
    """Evidence on top of some of a model's columns, without regard to correlated noise.

    And (N, d) what these leave, whitened.
    """
    inside = fit.weights > 0
    weights = weight(fit)
    design = whitened_design(fit)[inside]
    data = (fit.residual + fit.columns @ fit.model.values) * weights
    marginal = Marginal(flattened(design)[:, kept], data[inside].ravel())
    left = np.zeros(data.shape)
    left[inside] = marginal.py.reshape(-1, data.shape[1])
    return marginal, left
