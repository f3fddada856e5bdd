"""Checks that bases and markers did not move while the rows were recorded.

Each interval of rows is tried with a base or marker at another place.  The part of the residual
that this explains is computed from the design, with all other parameters free (no fit is repeated).
"""

import math
from collections.abc import Callable
from itertools import combinations

import numpy as np
from scipy.special import fdtrc, gammaln

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.set_aside import SIGNIFICANT
from longarm_comp.core.effects.placements import BasePose, TipOffset
from longarm_comp.core.errors import JobError

CUTS = 64
"""Number of rows at which a move may begin or end in the first trial.

The best two of them are then refined.
"""
MOST_TAKEN = 0.5
"""Largest fraction of the squared residual that a move may explain without being an error."""


def refuse_moved_parts(fit: ModelFit) -> None:
    """Refuse rows during which a base or a marker moved.

    Raises:
        JobError: a move explains most of the residual of the fit. The error names the base or
            marker, and the rows in which it stood elsewhere.
    """
    kept = fit.weights > 0
    rows = fit.session.take(kept)
    # One noise in all lengths: a move along one axis looks like noise of that axis
    lengths = fit.noise_m > 0
    common = np.sqrt((fit.noise_m[lengths] ** 2).mean()) if lengths.any() else 1.0
    sigma = np.where(lengths, common / np.where(lengths, fit.metres, 1.0), fit.sigma)
    white = fit.whiten_with_residual(sigma)
    a, residual = white[:, :-1], white[:, -1].copy()
    fitted = np.linalg.qr(np.vstack([a, np.eye(a.shape[1])]))[0][: len(a)]
    residual -= fitted @ (fitted.T @ residual)
    square, equations = float(residual @ residual), int(rows.measured.sum())
    terms = [k for k, t in enumerate(fit.model.terms) if isinstance(t, BasePose | TipOffset)]
    found, tried = None, len(rows) * (len(rows) + 1) / 2 * max(len(terms), 1)
    # A move must explain more than gross errors of single rows do
    in_rows = fitted.reshape(len(rows), fit.width, -1), residual.reshape(len(rows), fit.width)
    least = _worth_of_gross_errors(*in_rows, rows.measured.sum(axis=1), fit.effective)
    least -= math.log(tried)
    for k in terms:
        mine = [i for i, slot in enumerate(fit.slots) if slot.term == k]
        free = equations - fit.effective - len(mine)
        if not mine or free < 1:
            continue
        each = (part.reshape(len(rows), fit.width, -1) for part in (fitted, a[:, mine], residual))
        first, end = _find_best_interval(_falls_by_interval(*each), len(rows))
        moving = np.repeat(
            (np.arange(len(rows)) >= first) & (np.arange(len(rows)) < end), fit.width
        )
        moved = a[:, mine] * moving[:, None]
        moved -= fitted @ (fitted.T @ moved)
        shift = linear.solve_posterior(moved, residual).u
        left = float(((residual - moved @ shift) ** 2).sum())
        chance = fdtrc(len(mine), free, (square - left) / len(mine) / (left / free))
        worth = free * math.log(left / square) + len(mine) * math.log(equations)
        if worth < least and chance * tried < SIGNIFICANT:
            least = worth
            last = "on" if end == len(rows) else f"to {rows.index[end - 1]}"
            found = (
                fit.model.terms[k].where,
                f"{rows.index[first]} {last}",
                math.sqrt(left / square),
            )
    if found is None:
        return
    where, when, share = found
    size = np.linalg.norm(fit.residual[kept] * fit.metres, axis=1)
    before = float(np.sqrt((size**2).mean()))
    if (share * before) ** 2 < (1.0 - MOST_TAKEN) * before**2:
        raise JobError(
            f"the rows fall into two groups in order: from index {when} the {where} "
            f"looks moved ({1e3 * before:.3g} -> {1e3 * share * before:.3g} mm); tell the "
            "groups by a column group (the base), or by another marker there",
            session=fit.session.source,
        )


def _worth_of_gross_errors(
    fitted: np.ndarray, residual: np.ndarray, equations: np.ndarray, effective: float
) -> float:
    """Return the change of the Bayesian information criterion if the worst rows are gross errors.

    It is 0 or negative; a lower value means a better explanation.  Each gross error has a place of
    its own, with as many parameters as the row has equations, (N,).

    Args:
        fitted: (N, d, p) orthonormal basis of what the parameters of the fit explain.
        residual: (N, d) whitened residual.
    """
    count, number, whole = len(residual), int(equations.sum()), float((residual**2).sum())
    left_over = np.eye(residual.shape[1]) - fitted @ fitted.transpose(0, 2, 1)
    own = np.linalg.solve(left_over + 1e-9 * np.eye(residual.shape[1]), residual[..., None])[..., 0]
    falls = (residual * own).sum(axis=1)
    worst = np.argsort(-falls)[: count // 4]
    left = np.maximum(whole - np.cumsum(falls[worst]), 1e-3 * whole)
    taken, gross = np.cumsum(equations[worst]), np.arange(1, len(worst) + 1)
    choices = gammaln(count + 1) - gammaln(gross + 1) - gammaln(count - gross + 1)
    free = np.maximum(number - effective - taken, 1.0)
    worth = free * np.log(left / whole) + taken * math.log(number) + choices
    return float(min(worth.min(initial=0.0), 0.0))


Falls = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _find_best_interval(falls: Falls, count: int) -> tuple[int, int]:
    """Return the interval [first, end) of rows in which a move explains most of the residual.

    An interval that starts with the first row is replaced by the rows after it, because they only
    show that a part moved between the two.
    """
    cuts = np.unique(np.linspace(0, count, min(count, CUTS) + 1).astype(int))
    pairs = np.array([pair for pair in combinations(cuts, 2) if pair != (0, count)])
    first, end = pairs[int(np.argmax(falls(*pairs.T)))].tolist()
    before = None
    while before != (first, end):
        before = first, end
        tried = np.arange(0 if end < count else 1, end)
        first = int(tried[np.argmax(falls(tried, np.full(len(tried), end)))])
        tried = np.arange(first + 1, count + (first > 0))
        end = int(tried[np.argmax(falls(np.full(len(tried), first), tried))])
    return (first, end) if first > 0 else (end, count)


def _falls_by_interval(fitted: np.ndarray, moving: np.ndarray, residual: np.ndarray) -> Falls:
    """Return a function that computes the reductions (K,) of the squared residual by K moves.

    Its arguments are the first rows (K,) and the ends (K,) of the intervals in which some
    parameters have other values.

    Args:
        fitted: (M, d, p) orthonormal basis of what the parameters of the fit explain.
        moving: (M, d, k) columns of the parameters that change, scaled by their priors.
        residual: (M, d, 1).
    """

    def sum_before(each: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])

    along = sum_before(np.einsum("ndk,ndo->nk", moving, residual))
    across = sum_before(np.einsum("ndp,ndk->npk", fitted, moving))
    own = sum_before(np.einsum("ndk,ndl->nkl", moving, moving))

    def falls(first: np.ndarray, end: np.ndarray) -> np.ndarray:
        t, c, s = (each[end] - each[first] for each in (along, across, own))
        size, ways = np.linalg.eigh(s - np.swapaxes(c, 1, 2) @ c)
        parts = np.einsum("nkl,nk->nl", ways, t) ** 2 / (np.maximum(size, 0.0) + 1.0)
        return np.asarray(parts.sum(axis=1))

    return falls
