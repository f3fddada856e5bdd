"""Columns of candidates at a fit, and the evidence on top of it or of a part of it."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.identify.candidates import CandidateColumns, Term
from longarm_comp.core.identify.linear import Marginal, Products
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
        """Evidence on top of the fit, the terms at some places taken out of it, columns added.

        A term with parameters leaves with its columns; one without gives its shift back to the
        data.
        """
        fitted = self._fitted
        kept = [k for k, s in enumerate(fitted.slots) if s.owner.key not in places]
        data = fitted.data
        for term in fitted.model.terms:
            if term.key in places and not slots_of(fitted.model.arm, [term]):
                data = data + fitted.whitened(self.shift([term])[..., None])[:, 0]
        return FitMarginal(fitted, kept, data, beside)

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


def shift_of(fitted: ModelFit, columns: CandidateColumns, terms: Sequence[Term]) -> np.ndarray:
    """(N, d) what fitted terms add to the rows, m or rad."""
    slots = slots_of(fitted.model.arm, terms)
    values = np.array([getattr(s.owner, s.parameter.name) for s in slots]) / priors(slots)
    moved = columns.of(terms) @ values
    fixed = [t for t in terms if not slots_of(fitted.model.arm, [t])]
    return np.asarray(moved + columns.shift(fixed) if fixed else moved)


def rms_shift(fitted: ModelFit, shift: np.ndarray) -> float:
    """RMS over the rows of a change (N, d, ...) as a length at the tip, m."""
    scale = fitted.metres.reshape(-1, *(1,) * (shift.ndim - 2))
    return float(np.sqrt(((shift * scale) ** 2).reshape(len(shift), -1).sum(-1).mean()))
