"""Moves the scales of forms, such as a threshold, to where the evidence is highest.

A row on the wrong side of a threshold is off by the whole jump, so it is set aside as an outlier.
Then the information that would have moved the threshold is lost. Therefore, if rows were set aside,
the form with which most rows agree is sought first (`measure_agreement`). In this comparison
outliers count too, each like a row at the limit of an outlier.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import BETTER, OUTLIER
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.discover.inputs import FINE_GRID, GRID
from longarm_comp.core.identify.posterior.offer import ROUNDING
from longarm_comp.core.identify.posterior.offers import evidence_of_each


def find_better_forms(
    fit: ModelFit, terms: Sequence[Term], candidates: Sequence[Candidate]
) -> dict[tuple[str, str], Term]:
    """Find the terms that fit better with other scales of their forms.

    Terms that were moved before are in their new form when the next one is judged.

    Args:
        fit: the fit that holds the terms.
        candidates: the library; its values of the scales are tried first.

    Returns:
        The moved terms, by effect and place.
    """
    fitted = {t.key: t for t in fit.model.terms}
    moved: dict[tuple[str, str], Term] = {}
    for term in terms:
        if term.scales():
            better = refine_form(fit, fitted[term.key], candidates, tuple(moved.values()))
            if better.variant != term.variant:
                moved[term.key] = better
    return moved


def refine_form(
    fit: ModelFit, term: Term, candidates: Sequence[Candidate], moved: Sequence[Term] = ()
) -> Term:
    """Return the term with the scales of highest evidence.

    The search begins with the scales' values in the library and goes on between them. The term is
    returned unchanged if the best is hardly better, because a new fit takes time.

    Args:
        fit: the fit that holds the term.
        term: the term as it is in the model.
        candidates: the library.
        moved: other terms of the model, in better forms that were found since the fit.
    """
    marginal = FitColumns(fit).marginal_without({t.key for t in (term, *moved)}, moved)

    def evidence(terms: Sequence[Term]) -> np.ndarray:
        each = [Candidate(term.name, (t,)) for t in terms]
        return evidence_of_each(fit, marginal, each)

    agree = _Agreement(fit, term, moved)
    scales = term.scales()
    if (fit.weights == 0).any():
        ends = [(float(getattr(term, field)), low) for field, (low, _) in scales.items()]
        lines = [np.linspace(low, high, FINE_GRID).tolist() for low, high in scales.values()]
        crosses = [
            [*centre[:k], value, *centre[k + 1 :]]
            for centre in zip(*ends, strict=True)
            for k, line in enumerate(lines)
            for value in line
        ]
        looks = [_set_scales(term, list(scales), np.array(point)) for point in crosses]
        if agree(looks).max() > agree([term])[0] + BETTER:
            return _search_scales(term, np.array(crosses), agree)
    tried = itertools.product(*(_list_tried_values(term, field, candidates) for field in scales))
    return _search_scales(term, np.array(list(tried)), evidence)


def _search_scales(
    term: Term, grid: np.ndarray, worth: Callable[[Sequence[Term]], np.ndarray]
) -> Term:
    """Return the term with the scales of highest worth, on finer and finer grids.

    It is unchanged if no form is better. The first grid (M, s) has M values of the s scales.
    """
    fields = list(term.scales())
    least = float(worth([term])[0]) + BETTER
    best, here = -np.inf, term
    closer = True
    while closer:
        found = worth([_set_scales(term, fields, point) for point in grid])
        chances = np.exp(found - found.max())
        mean = chances @ grid / chances.sum()
        centre = np.clip(mean, grid.min(axis=0), grid.max(axis=0))  # rounding may leave the scale
        largest = grid[int(np.argmax(found >= found.max() - ROUNDING))]  # of equals the first
        looked = [_set_scales(term, fields, point) for point in (centre, largest)]
        closer = False
        for moved, now in zip(looked, worth(looked).tolist(), strict=True):
            if now > best + BETTER:
                best, here, closer = now, moved, True
        reach = (
            _nearest_values(float(getattr(here, f)), np.unique(v))
            for f, v in zip(fields, grid.T, strict=True)
        )
        between = (np.linspace(low, high, GRID) for low, high in reach)
        grid = np.array(list(itertools.product(*between)))
    return here if best > least else term


def measure_agreement(fit: ModelFit, residual: np.ndarray) -> np.ndarray:
    """Return the log likelihood (...) of all rows, up to a constant; outliers are included.

    No row counts more than a row at the limit of an outlier.

    Args:
        fit: gives the noise of the channels.
        residual: (..., N, d) measured - predicted by some models, m or rad.
    """
    white = np.nan_to_num(residual / (fit.stated_noise_ratio(fit.session)[:, None] * fit.sigma))
    return np.asarray(-0.5 * np.minimum((white**2).sum(axis=-1), OUTLIER**2).sum(axis=-1))


class _Agreement:
    """The `measure_agreement` of the rows for other forms of a term; each is computed once.

    Args:
        now: the term as it is in the model.
        moved: other terms of the model, in better forms that were found since the fit.
    """

    def __init__(self, fit: ModelFit, now: Term, moved: Sequence[Term]) -> None:
        self._fit, self._columns, self._known = fit, FitColumns(fit), dict[object, float]()
        fitted = {t.key: t for t in fit.model.terms}
        rest = fit.residual + self._columns.shift_by([now, *(fitted[t.key] for t in moved)])
        self._rest = rest - self._columns.shift_by(moved) if moved else rest
        # If the shift is proportional to the parameters, no form needs a derivative by each of them
        self._is_linear = False
        if isinstance(now, Effect):
            whole, here = self._columns.shifts_of_whole([now])[0], self._columns.shift_by([now])
            self._is_linear = bool(np.abs(whole - here).max() <= 1e-9 * np.abs(here).max())

    def __call__(self, then: Sequence[Term]) -> np.ndarray:
        """Return the (T,) agreement of T other forms of the term."""
        new = list({t.variant: t for t in then if t.variant not in self._known}.values())
        if new:
            if self._is_linear:
                shifts = self._columns.shifts_of_whole(new)
            else:
                self._columns.prior_columns(new)  # all at once: much faster
                shifts = np.stack([self._columns.shift_by([each]) for each in new])
            rest = self._rest - shifts
            found = measure_agreement(self._fit, rest).tolist()
            self._known.update(zip((t.variant for t in new), found, strict=True))
        return np.array([self._known[t.variant] for t in then])


def _set_scales(term: Term, fields: Sequence[str], values: np.ndarray) -> Term:
    return dataclasses.replace(term, **dict(zip(fields, values.tolist(), strict=True)))


def neighbouring_values(
    term: Term, field: str, candidates: Sequence[Candidate]
) -> tuple[float, float]:
    """Return the next lower and next higher value of a term's scale in the library.

    If there is none, it is the end of the scale.
    """
    return _nearest_values(float(getattr(term, field)), _list_tried_values(term, field, candidates))


def _list_tried_values(term: Term, field: str, candidates: Sequence[Candidate]) -> list[float]:
    """Return the values of a scale in the library and its two ends, sorted."""
    tried = {float(getattr(t, field)) for c in candidates if c.name == term.name for t in c.terms}
    return sorted({*tried, *term.scales()[field]})


def _nearest_values(value: float, values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Return the next smaller and next larger of sorted values; the first or last if none.

    One that differs by rounding alone is neither: beyond it lies half of what is to be searched.
    """
    alike = 1e-9 * (values[-1] - values[0])
    low = max((v for v in values if v < value - alike), default=values[0])
    return low, min((v for v in values if v > value + alike), default=values[-1])
