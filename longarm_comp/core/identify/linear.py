"""The Gaussian problem under every fit: weights and noise of the rows, priors, bounds, evidence.

Rows are whitened (divided by the noise), parameters are scaled by their prior standard
deviations, so that the prior is the unit normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import lsq_linear


@dataclass(frozen=True)
class Posterior:
    """Solution of ``min |y - A u|^2 + |u|^2`` within bounds.

    Attributes:
        u: (p,) scaled parameters.
        covariance: (p, p) of u, bounds ignored.
        effective: number of parameters that the data determine (trace of the hat matrix).
    """

    u: np.ndarray
    covariance: np.ndarray
    effective: float


def solve(
    a: np.ndarray, y: np.ndarray, lower: np.ndarray | None = None, upper: np.ndarray | None = None
) -> Posterior:
    """MAP estimate of ``y = A u + e``, e and u unit normal, u within bounds.

    Args:
        a: (m, p) whitened, prior-scaled design.
        y: (m,) whitened data.
        lower, upper: (p,) bounds of u; none by default.
    """
    p = a.shape[1]
    gram = a.T @ a
    factor = np.linalg.cholesky(gram + np.eye(p))
    right = solve_triangular(factor, a.T @ y, lower=True)
    u = solve_triangular(factor.T, right, lower=False)
    if lower is not None and upper is not None and ((u < lower) | (u > upper)).any():
        u = lsq_linear(factor.T, right, bounds=(lower, upper), method="bvls").x
    inverse = cho_solve((factor, True), np.eye(p))
    return Posterior(u, inverse, float(p - np.trace(inverse)))


class Marginal:
    """Evidence of further columns, with the columns already there marginalised.

    With ``y = A u + B v + e`` and everything unit normal, the log Bayes factor of B against
    nothing is ``t'(I+S)^-1 t / 2 - ln|I+S| / 2``, ``S = B'PB``, ``t = B'Py``,
    ``P = I - A (I + A'A)^-1 A'``.  One Marginal serves any number of candidates.
    """

    def __init__(self, a: np.ndarray, y: np.ndarray) -> None:
        self.a, self.y = a, y
        self._factor = cho_factor(a.T @ a + np.eye(a.shape[1]), lower=True)
        self.py = self.project(y)

    def project(self, b: np.ndarray) -> np.ndarray:
        """P b: what the columns already there cannot (cheaply) take up."""
        return b - self.a @ cho_solve(self._factor, self.a.T @ b)

    def added(self, b: np.ndarray) -> Added:
        """Score of the columns b, (m, k)."""
        pb = self.project(b)
        s = b.T @ pb
        t = b.T @ self.py
        k = b.shape[1]
        factor = np.linalg.cholesky(np.eye(k) + (s + s.T) / 2)
        z = solve_triangular(factor, t, lower=True)
        mean = solve_triangular(factor.T, z, lower=False)
        covariance = cho_solve((factor, True), np.eye(k))
        half_log_det = float(np.log(np.diag(factor)).sum())
        gain = float(z @ z) / 2
        return Added(gain - half_log_det, gain, mean, covariance)


@dataclass(frozen=True)
class Added:
    """What further columns would bring.

    Attributes:
        log_bayes_factor: against leaving them out.
        fit_gain: gain in penalised log likelihood alone.
        mean: (k,) scaled parameters.
        covariance: (k, k) of them.
    """

    log_bayes_factor: float
    fit_gain: float
    mean: np.ndarray
    covariance: np.ndarray


OUTLIER = 4.2
"""Rows beyond this many robust standard deviations (per axis norm) get weight 0."""
MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""


def whiten(columns: np.ndarray, weights: np.ndarray, sigma: np.ndarray, rho: float) -> np.ndarray:
    """(N, 3, k) columns in m -> (3M, k) of the M rows of weight > 0, with unit white noise.

    Noise that is correlated by `rho` from row to row is whitened as AR(1), each row against
    the inlier before it.
    """
    kept = weights > 0
    rows = columns[kept] * (np.sqrt(weights[kept])[:, None] / sigma)[..., None]
    if rho != 0.0 and len(rows) > 1:
        free = (rows[1:] - rho * rows[:-1]) / np.sqrt(1.0 - rho * rho)
        rows = np.concatenate([rows[:1], free])
    return rows.reshape(3 * len(rows), columns.shape[-1])


def inliers(residual: np.ndarray, sigma: np.ndarray | None = None) -> np.ndarray:
    """(N, 3) residual -> (N,) 1, or 0 beyond `OUTLIER` robust standard deviations.

    A row is out by its largest axis, scaled by the larger of the robust spread and the
    known noise.
    """
    centre = np.median(residual, axis=0)
    robust = MAD * np.median(np.abs(residual - centre), axis=0)
    if sigma is not None and np.isfinite(sigma).all():
        robust = np.maximum(robust, sigma)
    worst = (np.abs(residual - centre) / np.maximum(robust, 1e-12)).max(axis=1)
    return (worst <= OUTLIER).astype(float)


def spread(residual: np.ndarray, weights: np.ndarray, effective: float) -> np.ndarray:
    """(3,) noise per axis from weighted residuals, degrees of freedom shared by the axes."""
    count = max(weights.sum() - effective / 3, 1.0)
    return np.maximum(np.sqrt((weights[:, None] * residual**2).sum(0) / count), 1e-7)
