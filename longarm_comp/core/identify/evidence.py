"""Evidence: what a candidate would bring on top of a fit, all else marginalised.

Also in which form it brings most, between the forms that were tried.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.identify.candidates import Candidate, CandidateColumns, Term, distinct
from longarm_comp.core.identify.linear import Added, Marginal, Products, log_mass
from longarm_comp.core.identify.model_fit import ModelFit, priors
from longarm_comp.core.model.model import slots_of


def columns_at(fitted: ModelFit) -> FitColumns:
    """Columns of any candidate at the rows and the solution of a fit; kept with it."""
    held = fitted.__dict__.get("_candidates")
    if held is None:
        held = fitted.__dict__["_candidates"] = FitColumns(fitted)
    return cast(FitColumns, held)


@dataclass(frozen=True)
class Scaled(Products):
    """Prior-scaled columns of a candidate in units of the noise, with their products.

    Attributes:
        lower, upper: (k,) bounds of the parameters in prior standard deviations.
        widths: (k,) prior standard deviations.
    """

    lower: np.ndarray
    upper: np.ndarray
    widths: np.ndarray


class FitColumns(CandidateColumns):
    """Columns of candidates at a fit, and their products with its design: each computed once."""

    def __init__(self, fitted: ModelFit) -> None:
        super().__init__(fitted.model, fitted.posture, fitted.session)
        self._fitted = fitted
        self._cross: dict[tuple[object, ...], tuple[np.ndarray, np.ndarray]] = {}
        self._scaled: dict[tuple[object, ...], Scaled] = {}

    def prepare(self, terms: Sequence[Term]) -> None:
        """All that is asked of some terms later, at once: much faster than one by one."""
        fixed = [t for t in terms if not slots_of(self.model.arm, [t])]
        if fixed:
            self.shift(fixed)
        new = [t for t in terms if t.variant not in self._cross]
        if not new:
            return
        turned = np.ascontiguousarray(self._fitted.whitened(self.of(new)).T)
        cross = self._fitted.design.T @ turned.T
        start = 0
        for term in new:
            mine = slice(start, start + len(slots_of(self.model.arm, [term])))
            start = mine.stop
            self._cross[term.variant] = turned[mine].T, cross[:, mine]

    def without(
        self, places: Container[tuple[str, str]], beside: np.ndarray | None = None
    ) -> FitMarginal:
        """`marginal_without` of the fit."""
        return marginal_without(self._fitted, self, places, beside)

    def scaled(self, terms: Sequence[Term]) -> Scaled:
        """Columns of some terms, fitted together."""
        known = tuple(term.variant for term in terms)
        if known not in self._scaled:
            self._scaled[known] = self._together(terms)
        return self._scaled[known]

    def _together(self, terms: Sequence[Term]) -> Scaled:
        self.prepare(terms)
        design = self._fitted.design
        none = np.zeros((len(design), 0)), np.zeros((design.shape[1], 0))
        parts = [none, *(self._cross[term.variant] for term in terms)]
        b = np.concatenate([b.T for b, _ in parts]).T
        slots = slots_of(self.model.arm, terms)
        widths = priors(slots)
        lower = np.array([s.parameter.lower for s in slots]) / widths
        upper = np.array([s.parameter.upper for s in slots]) / widths
        cross = np.concatenate([cross for _, cross in parts], axis=1)
        return Scaled(b, b.T @ b, cross, lower, upper, widths)


class FitMarginal(Marginal):
    """Evidence on top of a fit, or of a part of it.

    Args:
        fitted: the fit.
        kept: positions of its parameters that stay, all else left out; all of them by default.
        data: (m,) instead of the fit's own.
        beside: (m, e) columns that are there too, in units of the noise and of their priors.
    """

    def __init__(
        self,
        fitted: ModelFit,
        kept: ArrayLike | None = None,
        data: np.ndarray | None = None,
        beside: np.ndarray | None = None,
    ) -> None:
        every = np.arange(len(fitted.slots))
        self._kept = every if kept is None else np.array(kept, dtype=int)
        self._beside = beside
        design, gram = fitted.design[:, self._kept], fitted.gram[np.ix_(self._kept, self._kept)]
        if beside is not None:
            cross = design.T @ beside
            gram = np.block([[gram, cross], [cross.T, beside.T @ beside]])
            design = np.concatenate([design, beside], axis=1)
        super().__init__(design, fitted.data if data is None else data, gram)

    def of(self, each: Sequence[Products]) -> list[tuple[np.ndarray, np.ndarray]]:
        """`normals` of columns whose products with the fit's whole design are known."""
        return self.normals([Products(w.b, w.gram, self._crossed(w)) for w in each])

    def _crossed(self, white: Products) -> np.ndarray:
        cross = white.cross[self._kept]
        if self._beside is None:
            return cross
        return np.concatenate([cross, self._beside.T @ white.b])


@dataclass(frozen=True)
class Score:
    """One candidate against the model without it.

    Attributes:
        candidate: the hypothesis.
        log_bayes_factor: evidence gained, bounds of the parameters counted.
        fit_gain: gain in penalised log likelihood.
        mean: (k,) parameter estimates (SI).
    """

    candidate: Candidate
    log_bayes_factor: float
    fit_gain: float
    mean: np.ndarray


def marginal_without(
    fitted: ModelFit,
    columns: CandidateColumns,
    places: Container[tuple[str, str]],
    beside: np.ndarray | None = None,
) -> FitMarginal:
    """Evidence on top of a fit, the terms at some places taken out of it, other columns added.

    A term with parameters leaves with its columns; one without gives its shift back to the data.
    """
    kept = [k for k, s in enumerate(fitted.slots) if s.owner.key not in places]
    data = fitted.data
    for term in fitted.model.terms:
        if term.key in places and not slots_of(fitted.model.arm, [term]):
            data = data + fitted.whitened(columns.shift([term])[..., None])[:, 0]
    return FitMarginal(fitted, kept, data, beside)


def shift_of(fitted: ModelFit, columns: CandidateColumns, terms: Sequence[Term]) -> np.ndarray:
    """(N, d) what fitted terms add to the rows, m or rad."""
    slots = slots_of(fitted.model.arm, terms)
    values = np.array([getattr(s.owner, s.parameter.name) for s in slots]) / priors(slots)
    moved = columns.of(terms) @ values
    fixed = [t for t in terms if not slots_of(fitted.model.arm, [t])]
    return np.asarray(moved + columns.shift(fixed) if fixed else moved)


def score(
    fitted: ModelFit, marginal: FitMarginal, candidate: Candidate, columns: FitColumns
) -> Score:
    """Evidence of a candidate on top of a marginal."""
    return scores(fitted, marginal, [candidate], columns)[0]


def scores(
    fitted: ModelFit, marginal: FitMarginal, candidates: Sequence[Candidate], columns: FitColumns
) -> list[Score]:
    """Evidence of each of many candidates on top of a marginal, those of one size at once."""
    columns.prepare(distinct(candidates))
    made: list[Score | None] = []
    sized: dict[int, list[tuple[int, Scaled]]] = {}
    for k, candidate in enumerate(candidates):
        white = columns.scaled(candidate.terms)
        size = len(white.widths)
        if not size:
            made.append(_fixed(fitted, marginal, candidate, columns))
        elif not np.isfinite(white.gram).all() or not white.gram.any():
            made.append(Score(candidate, 0.0, 0.0, np.zeros(size)))
        else:
            made.append(None)
            sized.setdefault(size, []).append((k, white))
    for group in sized.values():
        whites = [white for _, white in group]
        s, t = (np.stack(parts) for parts in zip(*marginal.of(whites), strict=True))
        added = Added.of(s, t)
        lower, upper = np.stack([w.lower for w in whites]), np.stack([w.upper for w in whites])
        factor = _bounded(added, lower, upper)
        mean = np.clip(added.mean, lower, upper) * np.stack([w.widths for w in whites])
        for n, (k, _) in enumerate(group):
            gain = float(added.fit_gain[n])
            made[k] = Score(candidates[k], float(factor[n]), gain, mean[n])
    return cast(list[Score], made)


def _bounded(added: Added, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """(...) log Bayes factors, bounds (..., k) of the parameters counted."""
    if not (np.isfinite(lower) | np.isfinite(upper)).any():
        return added.log_bayes_factor
    sd = np.sqrt(np.diagonal(added.covariance, axis1=-2, axis2=-1))
    inside = log_mass((lower - added.mean) / sd, (upper - added.mean) / sd)
    return np.asarray(added.log_bayes_factor + (inside - log_mass(lower, upper)).sum(-1))


def _fixed(
    fitted: ModelFit, marginal: Marginal, candidate: Candidate, columns: FitColumns
) -> Score:
    """An effect without parameters: it is there, whole, or it is not."""
    shift = columns.shift(candidate.terms)
    white = fitted.whitened(shift[..., None])[:, 0]
    projected = marginal.project(white)
    gain = float(projected @ marginal.y - 0.5 * projected @ white)
    paid = sum(term.price(fitted.model.arm) for term in candidate.terms)
    return Score(candidate, gain - paid, gain, np.zeros(0))


def rms_shift(fitted: ModelFit, shift: np.ndarray) -> float:
    """RMS over the rows of a change (N, d, ...) as a length at the tip, m."""
    scale = fitted.metres.reshape(-1, *(1,) * (shift.ndim - 2))
    return float(np.sqrt(((shift * scale) ** 2).reshape(len(shift), -1).sum(-1).mean()))


IMPLAUSIBLE = 5.0
"""Prior standard deviations beyond which nobody believes a size."""
LOOKS = 9
"""Values looked at side by side; then as many again around the best of them."""
WORTH = 0.5
"""Log evidence that a form must bring to be taken instead of the one that is there."""
SWEEPS = 2
"""Times that every scale is gone along, where a term has several."""


def refined(
    fit: ModelFit,
    marginal: FitMarginal,
    columns: FitColumns,
    term: Term,
    candidates: Sequence[Candidate],
) -> Score:
    """The term in the form of highest evidence between the neighbouring tried values.

    As it is, where that is hardly better: a refit costs more than it brings.

    Args:
        fit: whose rows, noise and weights count.
        marginal: what is in the model beside the term.
        columns: of candidates at the fit's rows.
        term: where it starts from; one without scales is scored as it is.
        candidates: their values of the scales are the tried ones.
    """

    def scored(terms: Sequence[Term]) -> list[Score]:
        return scores(fit, marginal, [Candidate(term.name, (t,)) for t in terms], columns)

    start = best = scored([term])[0]
    for _ in range(min(len(term.scales()), SWEEPS)):
        for field in term.scales():
            low, high = neighbours(term, field, candidates)
            for _ in range(2):
                here = best.candidate.terms[0]
                values = np.linspace(low, high, LOOKS)
                moved = [dataclasses.replace(here, **{field: float(v)}) for v in values]
                best = max(best, *scored(moved), key=lambda s: s.log_bayes_factor)
                step = (high - low) / (LOOKS - 1)
                centre = float(getattr(best.candidate.terms[0], field))
                low, high = max(low, centre - step), min(high, centre + step)
    return best if best.log_bayes_factor > start.log_bayes_factor + WORTH else start


def neighbours(term: Term, field: str, candidates: Sequence[Candidate]) -> tuple[float, float]:
    """The values of a scale that were tried to either side of a term's, or the scale's ends."""
    least, largest = term.scales()[field]
    value = float(getattr(term, field))
    tried = {float(getattr(t, field)) for c in candidates if c.name == term.name for t in c.terms}
    low = max((v for v in tried if v < value), default=least)
    high = min((v for v in tried if v > value), default=largest)
    return low, high
