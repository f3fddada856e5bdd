"""Checks that the arm and its markers stayed where they were while the rows were recorded.

From each row on in turn, a base or a marker is supposed to stand elsewhere. How much of the
residual that would explain is computed from the design, with everything fitted anew (no fit is
repeated).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import f

from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.set_aside import SIGNIFICANT
from longarm_comp.core.effects.placements import BasePose, TipOffset
from longarm_comp.core.errors import JobError

MOST_TAKEN = 0.5
"""Share of the squared residual that a move may take: beyond it, it is what is wrong."""


def refuse_moved_parts(fit: ModelFit) -> None:
    """Refuse rows during which a base or a marker moved.

    Raises:
        JobError: a move explains most of what the fit leaves; it names the base or marker, and the
            row from which on it stood elsewhere.
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
    found, least = None, 0.0
    terms = [k for k, t in enumerate(fit.model.terms) if isinstance(t, BasePose | TipOffset)]
    for k in terms:
        mine = [i for i, slot in enumerate(fit.slots) if slot.term == k]
        free = equations - fit.effective - len(mine)
        if not mine or free < 1:
            continue
        each = (part.reshape(len(rows), fit.width, -1) for part in (fitted, a[:, mine], residual))
        falls = _falls_by_row(*each)
        at = int(np.argmax(falls))
        left = max(square - float(falls[at]), 1e-12 * square)
        chance = f.sf((square - left) / len(mine) / (left / free), len(mine), free)
        worth = free * math.log(left / square) + len(mine) * math.log(equations)
        if worth < least and chance * len(falls) * len(terms) < SIGNIFICANT:
            least = worth
            found = fit.model.terms[k].where, int(rows.index[at]), math.sqrt(left / square)
    if found is None:
        return
    where, index, share = found
    size = np.linalg.norm(fit.residual[kept] * fit.metres, axis=1)
    before = float(np.sqrt((size**2).mean()))
    if (share * before) ** 2 < (1.0 - MOST_TAKEN) * before**2:
        raise JobError(
            f"the rows fall into two groups in order: from row {index} on the {where} "
            f"looks moved ({1e3 * before:.3g} -> {1e3 * share * before:.3g} mm); tell the "
            "groups by a column group (the base), or by another marker from there on",
            session=fit.session.source,
        )


def _falls_by_row(fitted: np.ndarray, moving: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return (M,) by how much the squared residual falls if some parameters change at each row.

    Args:
        fitted: (M, d, p) orthonormal basis of what the parameters of the fit explain.
        moving: (M, d, k) columns of the parameters that change, scaled by their priors.
        residual: (M, d, 1).
    """

    def sum_from_row_on(each: np.ndarray) -> np.ndarray:
        return np.cumsum(each[::-1], axis=0)[::-1]

    along = sum_from_row_on(np.einsum("ndk,ndo->nk", moving, residual))
    across = sum_from_row_on(np.einsum("ndp,ndk->npk", fitted, moving))
    own = sum_from_row_on(np.einsum("ndk,ndl->nkl", moving, moving))
    size, ways = np.linalg.eigh(own - np.swapaxes(across, 1, 2) @ across)
    parts = np.einsum("nkl,nk->nl", ways, along) ** 2 / (np.maximum(size, 0.0) + 1.0)
    return np.asarray(parts.sum(axis=1))
