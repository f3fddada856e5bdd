"""Which rows count, how noisy they are, and rows in units of that noise."""

from __future__ import annotations

import numpy as np

OUTLIER = 4.2
"""Rows beyond this many robust standard deviations (per axis norm) get weight 0."""
_MAD = 1.4826


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
    robust = _MAD * np.median(np.abs(residual - centre), axis=0)
    if sigma is not None and np.isfinite(sigma).all():
        robust = np.maximum(robust, sigma)
    worst = (np.abs(residual - centre) / np.maximum(robust, 1e-12)).max(axis=1)
    return (worst <= OUTLIER).astype(float)


def spread(residual: np.ndarray, weights: np.ndarray, effective: float) -> np.ndarray:
    """(3,) noise per axis from weighted residuals, degrees of freedom shared by the axes."""
    count = max(weights.sum() - effective / 3, 1.0)
    return np.maximum(np.sqrt((weights[:, None] * residual**2).sum(0) / count), 1e-7)
