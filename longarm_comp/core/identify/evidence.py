"""Evidence: what one candidate would bring on top of a fit, everything else marginalised."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.fit import Fit
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.model.model import Slot, slots_of


def columns_at(fitted: Fit) -> Columns:
    """Columns of any candidate at the rows and the solution of a fit."""
    rows = fitted.session
    q = [rows.q[:, j] for j in range(rows.n)]
    return Columns(fitted.model, fitted.model.posture(q, rows.context()))


@dataclass(frozen=True)
class Score:
    """One candidate against the model without it.

    Attributes:
        candidate: the hypothesis.
        log_bayes_factor: evidence gained, sign bounds counted.
        fit_gain: gain in penalised log likelihood.
        mean: (k,) parameter estimates (SI).
        sd: (k,) their posterior standard deviations.
        effect_m: RMS tip shift that it stands for, m.
    """

    candidate: Candidate
    log_bayes_factor: float
    fit_gain: float
    mean: np.ndarray
    sd: np.ndarray
    effect_m: float


def key(term: Term) -> tuple[str, str]:
    """An effect at a place: it can be there in one form only."""
    return term.name, term.place


def marginal_without(fitted: Fit, columns: Columns, places: set[tuple[str, str]]) -> Marginal:
    """Evidence on top of a fit, the terms at some places taken out of it.

    A term with parameters leaves with its columns; one without gives its shift back to the data.
    """
    kept = [k for k, s in enumerate(fitted.slots) if key(s.owner) not in places]
    data = fitted.data
    for term in fitted.model.terms:
        if key(term) in places and not slots_of(fitted.model.arm, [term]):
            data = data + fitted.whitened(columns.shift([term])[..., None])[:, 0]
    return Marginal(fitted.design[:, kept], data)


def score(fitted: Fit, marginal: Marginal, candidate: Candidate, columns: Columns) -> Score:
    """Evidence of a candidate on top of a marginal."""
    slots = candidate.slots(fitted.model.arm)
    if not slots:
        return _fixed(fitted, marginal, candidate, columns)
    scaled = columns.of(candidate.terms)
    white = fitted.whitened(scaled)
    if not np.isfinite(white).all() or not white.any():
        zero = np.zeros(len(slots))
        return Score(candidate, 0.0, 0.0, zero, zero, 0.0)
    added = marginal.added(white)
    sd = np.sqrt(np.diag(added.covariance))
    bounded = np.array([s.parameter.lower == 0.0 for s in slots])
    sided = (math.log(2.0) + norm.logcdf(added.mean / sd))[bounded].sum()
    mean = np.where(bounded, np.maximum(added.mean, 0.0), added.mean)
    scale = _prior(slots)
    return Score(
        candidate,
        added.log_bayes_factor + float(sided),
        added.fit_gain,
        mean * scale,
        sd * scale,
        _rms(scaled @ mean),
    )


def _fixed(fitted: Fit, marginal: Marginal, candidate: Candidate, columns: Columns) -> Score:
    """An effect without parameters: it is there, whole, or it is not."""
    shift = columns.shift(candidate.terms)
    white = fitted.whitened(shift[..., None])[:, 0]
    projected = marginal.project(white)
    gain = float(projected @ marginal.y - 0.5 * projected @ white)
    empty = np.zeros(0)
    return Score(candidate, gain, gain, empty, empty, _rms(shift))


def _rms(shift: np.ndarray) -> float:
    return float(np.sqrt((shift**2).sum(-1).mean()))


def _prior(slots: Sequence[Slot]) -> np.ndarray:
    return np.array([s.parameter.prior for s in slots])
