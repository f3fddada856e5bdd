"""Whether the arm and its markers stayed where they were while the rows were recorded.

Behind every row in turn a base, or a marker, may stand elsewhere: how much of the residual that
takes is computed from the design, with everything fitted anew (no fit is repeated).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from longarm_comp.core.calibration.linear import whiten
from longarm_comp.core.calibration.model_fit import ModelFit, priors
from longarm_comp.core.data.set_aside import SIGNIFICANT
from longarm_comp.core.effects.placements import BasePose, TipOffset
from longarm_comp.core.errors import JobError

MOST_TAKEN = 0.5
"""Share of the squared residual that a move may take: beyond it, it is what is wrong."""


@dataclass(frozen=True)
class Moved:
    """What stood elsewhere from a row on: its name, the row's index, RMS errors (m)."""

    what: str
    index: int
    before: float
    after: float


def moved(fit: ModelFit) -> Moved | None:
    """The base or marker whose move explains most of what a fit leaves; None where none does."""
    rows = fit.session.take(fit.weights > 0)
    a, residual = _even(fit)
    fitted = np.linalg.qr(np.vstack([a, np.eye(a.shape[1])]))[0][: len(a)]
    residual -= fitted @ (fitted.T @ residual)
    square, equations = float(residual @ residual), int(rows.measured.sum())
    best, least = None, 0.0
    terms = [k for k, t in enumerate(fit.model.terms) if isinstance(t, BasePose | TipOffset)]
    for k in terms:
        mine = [i for i, slot in enumerate(fit.slots) if slot.term == k]
        free = equations - fit.effective - len(mine)
        if not mine or free < 1:
            continue
        each = (part.reshape(len(rows), fit.width, -1) for part in (fitted, a[:, mine], residual))
        taken = _taken(*each)
        at = int(np.argmax(taken))
        left = max(square - float(taken[at]), 1e-12 * square)
        chance = f.sf((square - left) / len(mine) / (left / free), len(mine), free)
        worth = free * math.log(left / square) + len(mine) * math.log(equations)
        if worth < least and chance * len(taken) * len(terms) < SIGNIFICANT:
            least = worth
            size = np.linalg.norm(fit.residual[fit.weights > 0] * fit.metres, axis=1)
            before = float(np.sqrt((size**2).mean()))
            what, after = fit.model.terms[k].where, before * math.sqrt(left / square)
            best = Moved(what, int(rows.index[at]), before, after)
    told = best is not None and best.after**2 < (1.0 - MOST_TAKEN) * best.before**2
    return best if told else None


def _even(fit: ModelFit) -> tuple[np.ndarray, np.ndarray]:
    """Prior-scaled design (dM, p) and residual (dM,) of the inliers, in units of a noise that is
    one in all lengths: a move along one axis looks like noise of that axis."""
    lengths = fit.noise_m > 0
    common = np.sqrt((fit.noise_m[lengths] ** 2).mean()) if lengths.any() else 1.0
    sigma = np.where(lengths, common / np.where(lengths, fit.metres, 1.0), fit.sigma)
    both = np.concatenate([fit.columns * priors(fit.slots), fit.residual[..., None]], axis=-1)
    white = whiten(both, fit.weights, sigma, 0.0, fit.session.measured)
    return white[:, :-1], white[:, -1].copy()


def _taken(fitted: np.ndarray, moving: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """(M,) fall of the squared residual where some parameters are others from a row on.

    Args:
        fitted: (M, d, p) orthonormal: what the parameters of the fit take.
        moving: (M, d, k) columns of the parameters that change, scaled by their priors.
        residual: (M, d, 1).
    """

    def behind(each: np.ndarray) -> np.ndarray:
        return np.cumsum(each[::-1], axis=0)[::-1]

    along = behind(np.einsum("ndk,ndo->nk", moving, residual))
    across = behind(np.einsum("ndp,ndk->npk", fitted, moving))
    own = behind(np.einsum("ndk,ndl->nkl", moving, moving))
    size, ways = np.linalg.eigh(own - np.swapaxes(across, 1, 2) @ across)
    parts = np.einsum("nkl,nk->nl", ways, along) ** 2 / (np.maximum(size, 0.0) + 1.0)
    return np.asarray(parts.sum(axis=1))


def check_lasting(fit: ModelFit) -> None:
    """Base and markers must have stayed where they were: else `JobError`."""
    found = moved(fit)
    if found is not None:
        raise JobError(
            f"the rows fall into two groups in order: from row {found.index} on the {found.what} "
            f"looks moved ({1e3 * found.before:.3g} -> {1e3 * found.after:.3g} mm); tell the "
            "groups by a column group (the base), or by another marker from there on",
            session=fit.session.source,
        )
