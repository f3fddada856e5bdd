"""Columns of candidates at a fit, and the evidence on top of it or of a part of it."""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np

from longarm_comp.core.calibration.candidates import CandidateColumns, Term
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit, priors
from longarm_comp.core.model.model import slots_of


class FitColumns(CandidateColumns):
    """Columns of any candidate at the rows and the solution of a fit, each computed once.

    They are kept with the fit and go with it.
    """

    def __init__(self, fitted: ModelFit) -> None:
        super().__init__(fitted.model, fitted.posture, fitted.session)
        self._fitted = fitted
        self._known, self._shifts, self._white = fitted.known_columns

    def without(self, places: Container[tuple[str, str]]) -> Marginal:
        """Evidence on top of the fit, the terms at some places taken out of it.

        A term with parameters leaves with its columns; one without gives its shift back to the
        data.
        """
        fitted = self._fitted
        kept = [k for k, s in enumerate(fitted.slots) if s.owner.key not in places]
        data = fitted.data
        for term in fitted.model.terms:
            if term.key in places and not slots_of(fitted.model.arm, [term]):
                data = data + fitted.whitened(self.shift([term])[..., None])[:, 0]
        return Marginal(fitted.design[:, kept], data, fitted.gram[np.ix_(kept, kept)])

    def white(self, terms: Sequence[Term]) -> np.ndarray:
        """(m, k) columns of some terms side by side, in units of the noise."""
        known = tuple(term.variant for term in terms)
        if known not in self._white:
            self._white[known] = self._fitted.whitened(self.of(terms))
        return self._white[known]


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
