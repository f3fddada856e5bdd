"""Whether poses that no fit has seen err by more than the noise; said, and used for nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import gammaincinv
from scipy.stats import binomtest

from longarm_comp.core.data.measurement import equations, metres, posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.linear import inliers, solve
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.structure import SIGNIFICANT, Structure, smallest

OFF = 0.5
"""Excess over the noise, as a share of it, that counts: the noise itself is known to a tenth."""


def with_unseen(structure: Structure, fit: ModelFit, rows: Session) -> Structure:
    """The structure, also where only the held-out poses show it.

    What the parameters may err by moves all poses together, so it is taken off first. Of what is
    left half should be more than the median that noise gives (chi); a few gross errors among them
    change nothing.

    Args:
        structure: as it shows in the fitted rows.
        fit: final.
        rows: the hold-out.
    """
    found = equations(fit.model, rows, posture(fit.model, rows))
    known = dict(zip(fit.session.channels, fit.sigma, strict=True))
    sigma = np.array([known.get(name, np.inf) for name in rows.channels])
    held = rows.measured & np.isfinite(sigma)
    noise = np.where(np.isfinite(sigma), sigma, 1.0) * fit.uneven(rows)[:, None]
    some = held.any(axis=1)
    if structure.flag or not some.any():
        return structure
    size, ways = np.linalg.eigh(fit.covariance)
    moved = found.columns @ (ways * np.sqrt(np.maximum(size, 0.0)))
    a = (moved * (held / noise)[..., None])[some]
    size = _beyond(a, (found.residual * held / noise)[some], held[some])
    ratio = size / np.sqrt(2.0 * gammaincinv(held.sum(axis=1)[some] / 2, 0.5))
    count = max(round(len(ratio) * (1.0 - fit.rho) / (1.0 + fit.rho)), 1)  # rows that count
    above = round(float((ratio > 1.0).mean()) * count)
    p = float(binomtest(above, count, alternative="greater").pvalue)
    expected = np.sqrt(((noise * metres(fit.model, rows)) ** 2 * held).sum(1)[some].mean())
    excess = float(expected * np.sqrt(max(np.median(ratio) ** 2 - 1.0, 0.0)))
    if p > SIGNIFICANT or excess < max(OFF * expected, smallest(fit)):
        return structure
    return dataclasses.replace(
        structure,
        flag=True,
        p_value=min(p, structure.p_value),
        inputs=("held-out poses",),
        size_m=excess,
        sign="shows in the held-out poses",
    )


def _beyond(a: np.ndarray, y: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(N,) sizes of what unit normal parameters of columns (N, d, p) leave of data (N, d).

    Gross errors say nothing of the parameters, as in every fit.
    """
    kept = inliers(y, measured=measured)[:, None]
    shared = (kept[..., None] * a).reshape(-1, a.shape[-1])
    found = solve(shared, (kept * y).ravel())
    leverage = np.einsum("nip,pq,niq->ni", a, found.covariance, a, optimize=True)
    variance = np.where(kept > 0, np.maximum(1.0 - leverage, 1e-12), 1.0 + leverage)
    return np.linalg.norm((y - a @ found.u) / np.sqrt(variance), axis=1)
