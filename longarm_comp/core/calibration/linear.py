"""The Gaussian problem under every fit: weights and noise of the rows, priors, bounds, evidence.

Rows are whitened (divided by the noise), parameters are scaled by their prior standard
deviations, so that the prior is the unit normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import lsq_linear
from scipy.special import log_ndtr, logsumexp, ndtri

from longarm_comp.core.effects.fields import ALIKE


@dataclass(frozen=True)
class Posterior:
    """The solution of ``min |y - A u|^2 + |u|^2`` within bounds.

    Attributes:
        u: (p,) scaled parameters.
        covariance: (p, p) of u, bounds ignored.
        effective: number of parameters that the data determine (trace of the hat matrix).
    """

    u: np.ndarray
    covariance: np.ndarray
    effective: float


def solve_posterior(
    a: np.ndarray, y: np.ndarray, lower: np.ndarray | None = None, upper: np.ndarray | None = None
) -> Posterior:
    """Return the MAP estimate of ``y = A u + e``, e and u unit normal, u within any bounds (p,).

    Args:
        a, y: (m, p) whitened, prior-scaled design, and (m,) whitened data.
    """
    return solve_products(a.T @ a, a.T @ y, lower, upper)


def solve_products(
    gram: np.ndarray,
    moment: np.ndarray,
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
) -> Posterior:
    """Solve as `solve_posterior`, given the products ``A'A`` (p, p) and ``A'y`` (p,)."""
    p, factor = len(gram), _factor_with_prior(gram)
    right = solve_triangular(factor, moment, lower=True)
    u = solve_triangular(factor.T, right, lower=False)
    if lower is not None and upper is not None and ((u < lower) | (u > upper)).any():
        u = lsq_linear(factor.T, right, bounds=(lower, upper), method="bvls").x
    inverse = cho_solve((factor, True), np.eye(p))
    return Posterior(u, inverse, float(p - np.trace(inverse)))


def _factor_with_prior(gram: np.ndarray) -> np.ndarray:
    """Return a lower triangle (p, p) whose product with itself is ``gram + I``.

    No eigenvalue of that is below 1; where rounding takes one there, it is set to 1.
    """
    precision = gram + np.eye(len(gram))
    try:
        return np.asarray(np.linalg.cholesky(precision))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(precision)
        root = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 1.0))).T, mode="r")).T
        return np.asarray(root * np.sign(np.diag(root)))


_ROUNDING = 1e-9
"""Share of a variance that rounding leaves where nothing is left."""


def most_probable_within(
    mean: np.ndarray, covariance: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """Return the most probable values (p,) of a normal distribution within bounds (p,).

    Where a bound holds one value, those that are correlated with it follow.
    """
    if ((mean >= lower) & (mean <= upper)).all():
        return mean
    ends = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
    size = np.sqrt(np.maximum(np.diag(covariance)[ends], 1e-300))
    own = covariance[np.ix_(ends, ends)] / np.outer(size, size)
    values, vectors = np.linalg.eigh(own)
    white = (vectors / np.sqrt(np.maximum(values, _ROUNDING))).T
    limits = [(bound[ends] - mean[ends]) / size for bound in (lower, upper)]
    moved = lsq_linear(white, np.zeros(len(ends)), bounds=limits, method="bvls").x
    follows = covariance[:, ends] / size @ white.T @ (white @ moved)
    follows[ends] = moved * size
    return np.clip(mean + follows, lower, upper)


class Marginal:
    """The evidence of further columns, with the columns already there marginalised.

    With ``y = A u + B v + e`` and everything unit normal, the log Bayes factor of B against
    nothing is ``t'(I+S)^-1 t / 2 - ln|I+S| / 2``, ``S = B'PB``, ``t = B'Py``,
    ``P = I - A (I + A'A)^-1 A'``.  One Marginal serves any number of candidates.

    Args:
        a: (m, p) columns that are there already.
        y: (m,) data.
        gram: A'A, where it is known.
    """

    def __init__(self, a: np.ndarray, y: np.ndarray, gram: np.ndarray | None = None) -> None:
        self.a, self.y = a, y
        gram = a.T @ a if gram is None else gram
        self._factor = _factor_with_prior(gram), True
        self._coefficients = self._solve(a.T @ y)

    @property
    def evidence(self) -> float:
        """The log evidence of the columns already there, up to a constant of the data."""
        return float(-0.5 * self.y @ self.projected_data - np.log(np.diag(self._factor[0])).sum())

    @cached_property
    def projected_data(self) -> np.ndarray:
        """The (m,) projected data P y."""
        return self.y - self.a @ self._coefficients

    def project(self, b: np.ndarray) -> np.ndarray:
        """Return P b: the part of b that the columns already there cannot (cheaply) explain."""
        return b - self.a @ self._solve(self.a.T @ b)

    def project_products(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ``S`` (k, k) and ``t`` (k,) of further columns (m, k)."""
        cross = self.a.T @ b
        s = b.T @ b - cross.T @ self._solve(cross)
        return (s + s.T) / 2, b.T @ self.projected_data

    def _solve(self, right: np.ndarray) -> np.ndarray:
        return np.asarray(cho_solve(self._factor, right, check_finite=False))


def marginalise_first(
    gram: np.ndarray, along: np.ndarray, sizes: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Marginalise the first k columns, in the products of all (`Marginal.project_products`).

    Args:
        gram, along: (K, K) and (K,) products of the columns with themselves and with the data.
        sizes: (k,) prior standard deviations of the first k coefficients; 0 leaves a column out.

    Returns:
        Log Bayes factor of the first k against none; the two products of the other columns after
        it.
    """
    rest, on = slice(len(sizes), None), np.flatnonzero(sizes)
    size = sizes[on]
    own = gram[np.ix_(on, on)] * np.outer(size, size) + np.eye(len(on))
    factor = cho_factor(own, lower=True, check_finite=False)
    right = size[:, None] * np.concatenate([along[on, None], gram[on, rest]], axis=1)
    half = solve_triangular(factor[0], right, lower=True, check_finite=False)
    data, cross = half[:, 0], half[:, 1:]
    evidence = float(0.5 * data @ data - np.log(np.diag(factor[0])).sum())
    return evidence, gram[rest, rest] - cross.T @ cross, along[rest] - cross.T @ data


_WIDE = 18.0
"""Width of an interval, in standard deviations, at which the farther of its tails holds less than
rounding."""


def log_mass(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the log of the unit normal's mass between bounds."""
    flip = lower > -upper  # the smaller tail, where differences keep their digits
    low, high = np.where(flip, -upper, lower), np.where(flip, -lower, upper)
    mass = np.asarray(log_ndtr(high))
    near = high - low < _WIDE
    outside = np.exp(np.minimum(log_ndtr(low[near]) - mass[near], -1e-300))
    mass[near] += np.log1p(-outside)
    return mass


def prior_root(like: np.ndarray) -> np.ndarray:
    """Return a root R (..., k, k) of the prior covariance: coefficients are R w, w unit normal.

    Coefficients of one group are correlated by `ALIKE`.

    Args:
        like: (..., k) group numbers; coefficients of one group are like each other.
    """
    one, same = np.eye(like.shape[-1]), _in_same_group(like)
    return np.linalg.cholesky(np.where(one > 0, 1.0, ALIKE * same)) if (same > one).any() else one


def log_prior_mass(lower: np.ndarray, upper: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return (...) the log of the prior mass between bounds (..., k); the prior is that of
    `prior_root`."""
    same = _in_same_group(like)
    mates = same.sum(-1)
    alone = log_mass(lower, upper)
    if (mates == 1).all():
        return np.asarray(alone.sum(-1))
    shared, rest = math.sqrt(ALIKE) * _FACTOR, math.sqrt(1.0 - ALIKE)
    each = log_mass((lower[..., None] - shared) / rest, (upper[..., None] - shared) / rest)
    together = logsumexp(same @ each, axis=-1) - math.log(len(_FACTOR))
    return np.asarray((np.where(mates > 1, together, alone) / mates).sum(-1))


def _in_same_group(like: np.ndarray) -> np.ndarray:
    return np.asarray(like[..., :, None] == like[..., None, :])


_FACTOR = ndtri((np.arange(64) + 0.5) / 64)
"""A unit normal: what coefficients that are like each other have in common."""
SIZES = (1.0, 4.0, 16.0)
"""Prior standard deviations of what may be wrong, in its own prior's: few arms are so ill, and few
parts so far from their drawing, but some are."""
CHANCES = tuple(math.log(p) for p in (0.8, 0.15, 0.05))


def choose_sizes(
    mean: np.ndarray, sizes: np.ndarray, chances: np.ndarray, like: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return (..., k) most probable prior sizes of (..., k) coefficients, and their log chance
    (...).

    One place may be far worse than the next, and a base that sinks need not tilt. So each
    coefficient has a size of its own, but those that are like each other share one.

    Args:
        mean: the coefficients.
        sizes, chances: (..., k, s) prior standard deviations, and their log probabilities.
        like: as in `prior_root`; no two are alike where None.
    """
    if like is None:
        like = np.arange(mean.shape[-1])
    same = _in_same_group(like)
    white = np.linalg.solve(prior_root(like), mean[..., None])
    share = chances / same.sum(-1)[..., None]
    tried = same @ (share - 0.5 * (white / sizes) ** 2 - np.log(sizes))
    best = tried.argmax(axis=-1)[..., None]
    chance = np.take_along_axis(share, best, -1).sum((-1, -2))
    return np.take_along_axis(sizes, best, -1)[..., 0], chance


BETTER = 1.0
"""Log evidence by which an explanation, form or fit must be better to take the place of another.
"""
OUTLIER = 4.2
"""Rows beyond this many robust standard deviations (per axis norm) get weight 0."""
BEFOREHAND = 4.0
"""Equations that the noise of what is alike is worth: of a sensor's other channels, of arms of one
kind.  Among these it differs by about a third, as an estimate from so many does."""
MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""


def whiten_rows(
    columns: np.ndarray,
    weights: np.ndarray,
    sigma: np.ndarray,
    rho: float,
    measured: np.ndarray,
) -> np.ndarray:
    """Map (N, d, k) columns in m or rad to (dM, k), with unit white noise; M rows have weight > 0.

    Noise that is correlated by `rho` from row to row is whitened as AR(1), each channel against
    the inlier before it.  What was not measured must be 0 in the columns and stays so.

    Args:
        weights: (N,), 0 or how much a row counts.
        sigma: (d,) noise of the channels.
        measured: (N, d) which channels a row holds.
    """
    kept = weights > 0
    rows = columns[kept] * (np.sqrt(weights[kept])[:, None] / sigma)[..., None]
    if rho != 0.0 and len(rows) > 1:
        free = (rows[1:] - rho * rows[:-1]) / np.sqrt(1.0 - rho * rho)
        held = measured[kept]
        both = (held[1:] & held[:-1])[..., None]
        rows = np.concatenate([rows[:1], np.where(both, free, rows[1:])])
    return rows.reshape(columns.shape[1] * len(rows), columns.shape[-1])


def weigh_rows(residual: np.ndarray, uneven: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return (N,) how much each row counts: by the noise that it states, or all the same.

    Stated noise counts if it makes the residual more probable. That is judged by Laplace's law,
    whose scale in each channel is estimated, so that outliers, and a common factor, do not matter.

    Args:
        residual: (N, d).
        uneven: (N,) stated noise of each row over the usual one.
        measured: (N, d) which channels a row holds.
    """
    alike = np.ones(len(residual))
    if (uneven == 1.0).all():
        return alike
    size = np.maximum(np.abs(residual), 1e-12) * measured
    ratio = np.maximum(size.sum(0), 1e-12) / np.maximum((size / uneven[:, None]).sum(0), 1e-12)
    worth = measured.sum(0) @ np.log(ratio) - measured.sum(1) @ np.log(uneven)
    return uneven**-2.0 if worth > 0 else alike


def mark_inliers(
    residual: np.ndarray, measured: np.ndarray, sigma: np.ndarray | None = None
) -> np.ndarray:
    """Return (N,) 1, or 0 for rows beyond `OUTLIER` robust standard deviations, of (N, d)
    residuals.

    A row is judged by its largest channel, scaled by the larger of the robust spread and the
    known noise; only channels that were measured count.
    """
    held = np.where(measured, residual, np.nan)
    centre = channel_medians(held)
    robust = MAD * channel_medians(np.abs(held - centre))
    if sigma is not None and np.isfinite(sigma).all():
        robust = np.maximum(robust, sigma)
    worst = np.abs(held - centre) / np.maximum(robust, 1e-12)
    return (np.nan_to_num(worst).max(axis=1) <= OUTLIER).astype(float)


def estimate_noise(
    residual: np.ndarray, weights: np.ndarray, effective: float, measured: np.ndarray
) -> np.ndarray:
    """Return (d,) noise per channel from weighted residuals; all share the degrees of freedom.

    It is infinite for a channel that no inlier holds.
    """
    count = degrees_of_freedom(weights, effective, measured)
    sigma = np.maximum(np.sqrt((weights[:, None] * residual**2).sum(0) / count), 1e-7)
    return np.where(measured[weights > 0].any(0), sigma, np.inf)


def degrees_of_freedom(weights: np.ndarray, effective: float, measured: np.ndarray) -> np.ndarray:
    """Return (d,) degrees of freedom: a channel's inliers less its share of fitted parameters.

    It is at least 1, if the channel has any inlier.

    Args:
        weights: (N,).
        effective: number of parameters that the data determine.
        measured: (N, d).
    """
    count = measured[weights > 0].sum(0)
    share = count / max(count.sum(), 1.0)
    return np.maximum(count - effective * share, np.clip(count, 1e-12, 1.0))


def channel_medians(values: np.ndarray) -> np.ndarray:
    """Return (d,) medians of (N, d) over what is not NaN; 0 for an empty column."""
    if not np.isnan(values).any():
        return np.asarray(np.median(values, axis=0))
    columns = (column[~np.isnan(column)] for column in values.T)
    return np.array([np.median(column) if len(column) else 0.0 for column in columns])


def channel_means(values: np.ndarray) -> np.ndarray:
    """Return (d,) means of (N, d) over what is not NaN; 0 for an empty column."""
    held = np.isfinite(values)
    return np.asarray(np.where(held, values, 0.0).sum(0) / np.maximum(held.sum(0), 1))
