"""The design columns of candidates at a fit, and their evidence given the fit or a part of it."""

from collections.abc import Container, Sequence

import numpy as np

from longarm_comp.core.calibration.candidates import Term
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.measurement import compute_shifts, make_equations
from longarm_comp.core.model.model import Slot, slots_of


class FitColumns:
    """The design columns of any candidate at the rows and solution of a fit.

    Each column is computed once and stored with the fit.
    """

    def __init__(self, fitted: ModelFit) -> None:
        self.model, self._fitted = fitted.model, fitted
        self._known, self._shifts, self._white = fitted.known_columns

    def prior_columns(self, terms: Sequence[Term]) -> np.ndarray:
        """Compute the design columns of the parameters of some terms.

        Args:
            terms: the terms, in the model or not; the k parameters of all follow one another.

        Returns:
            (N, d, k) change of the d channels at the N rows by one prior standard deviation of each
            parameter, m or rad.
        """
        return self._columns_of(slots_of(self.model.arm, terms))

    def _columns_of(self, slots: tuple[Slot, ...]) -> np.ndarray:
        keys = [(*s.owner.variant, s.parameter.name) for s in slots]
        new = {k: s for k, s in zip(keys, slots, strict=True) if k not in self._known}
        if new:
            session, at, slots = self._fitted.session, self._fitted.posture, tuple(new.values())
            columns = make_equations(self.model, session, slots, at=at).columns
            columns = columns * prior_widths(slots)
            self._known.update(zip(new, np.moveaxis(columns, -1, 0), strict=True))
        if not keys:
            return np.zeros((*self._fitted.residual.shape, 0))
        return np.stack([self._known[key] for key in keys], axis=-1)

    def shift_by(self, terms: Sequence[Term]) -> np.ndarray:
        """Return the change (N, d) of the predictions by terms with their values, m or rad."""
        slots = slots_of(self.model.arm, terms)
        values = np.array([s.value for s in slots]) / prior_widths(slots)
        free = {s.term for s in slots}
        whole = [t for n, t in enumerate(terms) if n not in free]
        new = {t.variant: t for t in whole if t.variant not in self._shifts}
        if new:
            self._shifts.update(zip(new, self.shifts_of_whole(list(new.values())), strict=True))
        fixed = sum(self._shifts[t.variant] for t in whole)
        return np.asarray(self._columns_of(slots) @ values + fixed)

    def shifts_of_whole(self, terms: Sequence[Term]) -> np.ndarray:
        """Return the change (T, N, d) of the predictions by each of T terms, m or rad.

        The model does not hold them.  It is computed at once, not from the columns of parameters.
        """
        at = self._fitted.posture
        return np.moveaxis(compute_shifts(self.model, self._fitted.session, at, terms), -1, 0)

    def marginal_without(
        self,
        places: Container[tuple[str, str]],
        instead: Sequence[Term] = (),
        still: Container[tuple[str, str]] = (),
    ) -> Marginal:
        """Marginalise the columns of the fit without those of some terms.

        The columns of a removed term are left out.  If it has no parameters, the change that it
        causes is added to the data instead.  A term that acts through others keeps its value,
        because it has no influence without the removed terms.

        Args:
            places: keys of the terms that are removed.
            instead: terms with parameters that are added.
            still: keys of further terms that keep their values instead of being marginalised.

        Returns:
            The marginal, which gives the evidence of other columns.
        """
        fitted = self._fitted
        fixed = np.array(
            [s.owner.through_others or s.owner.key in still for s in fitted.slots], dtype=bool
        )
        kept = [k for k, s in enumerate(fitted.slots) if s.owner.key not in places and not fixed[k]]
        values = (fitted.model.values / prior_widths(fitted.slots))[kept]
        removed = (t for t in fitted.model.terms if t.key in places and not t.through_others)
        left = fitted.residual + self.shift_by([t for t in removed if t.key not in still])
        data = fitted.whiten_columns(left[..., None])[:, 0] + fitted.design[:, kept] @ values
        if not instead:
            return Marginal(fitted.design[:, kept], data, fitted.gram[np.ix_(kept, kept)])
        return Marginal(
            np.concatenate([fitted.design[:, kept], self.white_columns(instead)], axis=1), data
        )

    def white_columns(self, terms: Sequence[Term]) -> np.ndarray:
        """Return `prior_columns` of some terms, whitened: (dM, k) of the M inliers."""
        key = tuple(term.variant for term in terms)
        if key not in self._white:
            self._white[key] = self._fitted.whiten_columns(self.prior_columns(terms))
        return self._white[key]


def rms_shift(fitted: ModelFit, shift: np.ndarray) -> float:
    """Return the RMS over the rows of a change (N, d, ...) of the channels, as a tip length, m."""
    scale = fitted.metres.reshape(-1, *(1,) * (shift.ndim - 2))
    return float(np.sqrt(((shift * scale) ** 2).reshape(len(shift), -1).sum(-1).mean()))
