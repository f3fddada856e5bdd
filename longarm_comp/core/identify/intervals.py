"""95 % intervals of the parameters of a fit.

The standard deviation is the larger of two: by the Laplace approximation, and by `BLOCKS` blocks of
successive rows.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtri

from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.holdout import BLOCKS
from longarm_comp.core.identify.posterior.forms import neighbouring_values

LOOSE = 3.0
"""Smallest prior, as a multiple of the value found, that hardly changes the interval."""
TOUCHES = 0.05
"""A value counts as at its bound if it is nearer to it than this share of the interval, so that its
side of the interval is a twentieth at most."""


@dataclass(frozen=True)
class Interval:
    """A parameter's value and 95 % interval, SI units.

    Attributes:
        at_bound: whether the value is at a bound of the parameter (within `TOUCHES` of the
            interval). Then it is no estimate, and only the other end of the interval is useful.
    """

    value: float
    low: float
    high: float
    at_bound: bool = False


def compute_intervals(
    fit: ModelFit, found: Sequence[Term], candidates: Sequence[Candidate]
) -> dict[int, Interval]:
    """Compute the intervals of a fit's parameters, by position in its slots.

    The found effects may also act at other places, or have other values of their forms. These are
    added as columns with their priors, so the intervals are wider.

    Args:
        fit: the final fit.
        found: the terms that a search added.
        candidates: the library.
    """
    mine = {t.key for t in found}
    sizes = np.abs(fit.model.values) / prior_widths(fit.slots)
    sizes *= [slot.owner.key in mine for slot in fit.slots]
    wider = np.maximum(1.0, LOOSE * sizes)  # it exists, so its size should follow from the data
    columns = FitColumns(fit)
    otherwise = [columns.prior_columns(_other_places(fit, found, candidates))]
    otherwise += _change_of_scales(fit, columns, found, candidates)
    white = fit.whiten_columns(np.concatenate(otherwise, axis=-1))
    design = np.concatenate([fit.design * wider, white], axis=1)
    rows = len(design) // fit.width
    cuts = np.linspace(0, rows, min(BLOCKS, rows) + 1).astype(int) * fit.width
    parts = [slice(begin, end) for begin, end in pairwise(cuts)]
    gram = np.stack([design[s].T @ design[s] for s in parts])
    right = np.stack([design[s].T @ fit.data[s] for s in parts])
    one = np.eye(design.shape[1])
    inverse = np.linalg.inv(gram.sum(0) + one)
    u = inverse @ right.sum(0)
    pulls = (right - gram @ u) @ inverse
    robust = np.sqrt((pulls**2).sum(0) * len(parts) / max(len(parts) - 1, 1))
    kept = slice(len(fit.slots))
    scale = prior_widths(fit.slots) * wider
    centre = u[kept] * scale
    sd = np.maximum(robust, np.sqrt(np.diag(inverse)))[kept] * scale
    half = ndtri(0.975) * np.hypot(sd, centre - fit.model.values)
    made = {}
    for k, (slot, value) in enumerate(zip(fit.slots, fit.model.values, strict=True)):
        bounds = slot.parameter
        low = max(float(value - half[k]), bounds.lower)
        high = min(float(value + half[k]), bounds.upper)
        room = min(float(value) - bounds.lower, bounds.upper - float(value))
        made[k] = Interval(float(value), low, high, room <= TOUCHES * (high - low))
    return made


def _other_places(
    fit: ModelFit, found: Sequence[Term], candidates: Sequence[Candidate]
) -> tuple[Term, ...]:
    """List the terms at the other places of the found effects, if possible in the found form."""
    held = {t.key for t in fit.model.terms}
    missing: dict[tuple[str, str], Term] = {}
    forms = {t.name: tuple(t.forms.items()) for t in reversed(found)}
    for name, form in forms.items():
        mine = [c for c in candidates if c.name == name]
        for candidate in sorted(mine, key=lambda c: c.form != form):
            missing = {t.key: t for t in candidate.terms if t.key not in held} | missing
    return tuple(missing.values())


def _change_of_scales(
    fit: ModelFit, columns: FitColumns, found: Sequence[Term], candidates: Sequence[Candidate]
) -> list[np.ndarray]:
    """Return for each scale of the found terms the change of the rows (N, d, 1), m or rad.

    The scale moves by half the distance of the tried values to both sides of it.
    """
    held = {t.key: t for t in fit.model.terms}
    ways: list[tuple[Term, Term]] = []
    for term in (held[t.key] for t in found):
        for field in term.scales():
            low, high = neighbouring_values(term, field, candidates)
            here = float(getattr(term, field))
            half = 0.5 * (high - low) * (1.0 if here < 0.5 * (low + high) else -1.0)
            ways.append((term, dataclasses.replace(term, **{field: here + half})))
    columns.prior_columns([t for pair in ways for t in pair])  # all at once: much faster
    return [
        (columns.shift_by([moved]) - columns.shift_by([term]))[..., None] for term, moved in ways
    ]
