"""Whether poses that no fit has seen err by more than the noise; said, and used for nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import gammaincinv
from scipy.stats import binomtest

from longarm_comp.core.data.measurement import equations, metres, posture
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.structure import SIGNIFICANT, WORTH, Structure, smallest


def with_unseen(structure: Structure, fit: ModelFit, rows: Session) -> Structure:
    """The structure, also where only the held-out poses show it.

    Half of them should err by more than the median that noise and parameters give (chi); a few
    gross errors among them change nothing.

    Args:
        structure: as it shows in the fitted rows.
        fit: final.
        rows: the hold-out.
    """
    found = equations(fit.model, rows, posture(fit.model, rows))
    known = dict(zip(fit.session.channels, fit.sigma, strict=True))
    sigma = np.array([known.get(name, np.inf) for name in rows.channels])
    held = rows.measured & np.isfinite(sigma)
    own = np.einsum("nip,pq,niq->ni", found.columns, fit.covariance, found.columns, optimize=True)
    noise = np.where(np.isfinite(sigma), sigma, 1.0) * fit.uneven(rows)[:, None]
    spread = np.sqrt(noise**2 + own)
    some = held.any(axis=1)
    if structure.flag or not some.any():
        return structure
    size = np.linalg.norm(found.residual * held / spread, axis=1)[some]
    ratio = size / np.sqrt(2.0 * gammaincinv(held.sum(axis=1)[some] / 2, 0.5))
    p = float(binomtest(int((ratio > 1.0).sum()), len(ratio), alternative="greater").pvalue)
    expected = np.sqrt(((spread * metres(fit.model, rows)) ** 2 * held).sum(1)[some].mean())
    excess = float(expected * np.sqrt(max(np.median(ratio) ** 2 - 1.0, 0.0)))
    if p > SIGNIFICANT or excess < max(WORTH * expected, smallest(fit)):
        return structure
    return dataclasses.replace(
        structure,
        flag=True,
        p_value=min(p, structure.p_value),
        inputs=("unseen poses",),
        size_m=excess,
        sign="shows in the held-out poses",
    )
