"""The linear Gaussian problem of every fit: weights and noise of rows, priors, bounds, evidence.

Rows are whitened (divided by the noise). Parameters are scaled by their prior standard deviations,
so that the prior is the unit normal distribution.
"""

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
        covariance: (p, p) covariance of u, without the bounds.
        effective: number of parameters that the data determine (trace of the hat matrix).
    """

    u: np.ndarray
    covariance: np.ndarray
    effective: float


def solve_posterior(
    a: np.ndarray, y: np.ndarray, lower: np.ndarray | None = None, upper: np.ndarray | None = None
) -> Posterior:
    """Return the MAP estimate of u in ``y = A u + e``, with e and u unit normal.

    Args:
        a: (m, p) whitened, prior-scaled design.
        y: (m,) whitened data.
        lower, upper: (p,) bounds of u, if any.
    """
    return solve_products(a.T @ a, a.T @ y, lower, upper)


def solve_products(
    gram: np.ndarray,
    moment: np.ndarray,
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
) -> Posterior:
    """Solve as `solve_posterior` does, given the products ``A'A`` (p, p) and ``A'y`` (p,)."""
    p, factor = len(gram), _factor_with_prior(gram)
    right = solve_triangular(factor, moment, lower=True)
    u = solve_triangular(factor.T, right, lower=False)
    if lower is not None and upper is not None and ((u < lower) | (u > upper)).any():
        u = lsq_linear(factor.T, right, bounds=(lower, upper), method="bvls").x
    inverse = cho_solve((factor, True), np.eye(p))
    return Posterior(u, inverse, float(p - np.trace(inverse)))


def _factor_with_prior(gram: np.ndarray) -> np.ndarray:
    """Return the lower triangle L (p, p) with ``L L' = gram + I``.

    No eigenvalue of ``gram + I`` is below 1. If rounding makes it indefinite, such eigenvalues are
    set to 1.
    """
    precision = gram + np.eye(len(gram))
    try:
        return np.asarray(np.linalg.cholesky(precision))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(precision)
        root = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 1.0))).T, mode="r")).T
        return np.asarray(root * np.sign(np.diag(root)))


_ROUNDING = 1e-9
"""Ratio of variances below which a variance is rounding error."""


def most_probable_within(
    mean: np.ndarray, covariance: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """Return the most probable values (p,) of a normal distribution within bounds (p,).

    If a bound limits one value, values that are correlated with it change too.

    Args:
        mean: (p,) mean of the distribution.
        covariance: (p, p).
        lower, upper: (p,) bounds; infinite where there is none.
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
    """The evidence of further columns, with the present columns marginalised.

    With ``y = A u + B v + e`` and everything unit normal, the log Bayes factor of B against
    no further columns is ``t'(I+S)^-1 t / 2 - ln|I+S| / 2`` with ``S = B'PB``, ``t = B'Py``,
    ``P = I - A (I + A'A)^-1 A'``.  One `Marginal` is used for any number of candidates.

    Args:
        a: (m, p) present columns A.
        y: (m,) data.
        gram: A'A, if it is known.
    """

    def __init__(self, a: np.ndarray, y: np.ndarray, gram: np.ndarray | None = None) -> None:
        self.a, self.y = a, y
        gram = a.T @ a if gram is None else gram
        self._factor = _factor_with_prior(gram), True
        self._coefficients = self._solve(a.T @ y)

    @property
    def evidence(self) -> float:
        """The log evidence of the present columns, up to a constant that depends on the data."""
        return float(-0.5 * self.y @ self.projected_data - np.log(np.diag(self._factor[0])).sum())

    @cached_property
    def projected_data(self) -> np.ndarray:
        """The (m,) projected data P y."""
        return self.y - self.a @ self._coefficients

    def project(self, b: np.ndarray) -> np.ndarray:
        """Return P b (m, k): what the present columns, with their priors, leave of columns b."""
        return b - self.a @ self._solve(self.a.T @ b)

    def project_products(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ``S`` (k, k) and ``t`` (k,) of further columns b (m, k)."""
        cross = self.a.T @ b
        s = b.T @ b - cross.T @ self._solve(cross)
        return (s + s.T) / 2, b.T @ self.projected_data

    def _solve(self, right: np.ndarray) -> np.ndarray:
        return np.asarray(cho_solve(self._factor, right, check_finite=False))


def marginalise_first(
    gram: np.ndarray, along: np.ndarray, sizes: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Marginalise the first k of K columns, given the products of all of them.

    Args:
        gram, along: (K, K) and (K,) products S and t of `Marginal.project_products`.
        sizes: (k,) prior standard deviations of the first k coefficients; 0 leaves a column out.

    Returns:
        The log Bayes factor of the first k columns against none, and the two products of the other
        columns with the first k marginalised.
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
"""Width of an interval, in standard deviations, above which its farther tail is negligible."""


def log_mass(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the log probability (same shape) of a unit normal variable between two bounds."""
    # As of the mirrored interval, if its tail is the smaller one: differences keep their digits
    low, high = np.minimum(lower, -upper), np.minimum(upper, -lower)
    made, cut = np.zeros(high.shape), high < _WIDE / 2  # beyond, the tails are negligible
    low, high = low[cut], high[cut]
    mass = np.asarray(log_ndtr(high))
    near = high - low < _WIDE
    outside = np.exp(np.minimum(log_ndtr(low[near]) - mass[near], -1e-300))
    mass[near] += np.log1p(-outside)
    made[cut] = mass
    return made


def prior_root(like: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor R (..., k, k) of the prior covariance of k coefficients.

    Coefficients of one group have the correlation `ALIKE`, others none; the variances are 1.

    Args:
        like: (..., k) number of each coefficient's group.
    """
    one, same = np.eye(like.shape[-1]), _in_same_group(like)
    return np.linalg.cholesky(np.where(one > 0, 1.0, ALIKE * same)) if (same > one).any() else one


def log_prior_mass(lower: np.ndarray, upper: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return the log prior probability (...) that k coefficients lie between bounds.

    The prior is that of `prior_root`.

    Args:
        lower, upper: (..., k) bounds.
        like: (..., k) number of each coefficient's group.
    """
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
"""Quantiles of a unit normal variable: the common part of coefficients of one group."""
SIZES = (1.0, 4.0, 16.0)
"""Factors that may enlarge the prior standard deviation of a single coefficient.

Few effects are so large, and few parts so far from their drawing, but some are.
"""
CHANCES = tuple(math.log(p) for p in (0.8, 0.15, 0.05))


def choose_sizes(
    mean: np.ndarray, sizes: np.ndarray, chances: np.ndarray, like: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable prior sizes of k coefficients.

    One place may be far worse than the next, and a base that sinks need not tilt. So each
    coefficient has its own size, but coefficients of one group (`like`) have the same.

    Args:
        mean: (..., k) the coefficients.
        sizes: (..., k, s) prior standard deviations to choose from.
        chances: (..., k, s) log probabilities of these sizes.
        like: (..., k) number of each coefficient's group; by default each has its own.

    Returns:
        The sizes (..., k), and their log probability (...).
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
"""Difference of log evidence from which an explanation, form or fit replaces another."""
OUTLIER = 4.2
"""Rows beyond this many robust standard deviations in any channel get weight 0."""
BEFOREHAND = 4.0
"""Number of equations to which a known noise (of other channels of a sensor, or other arms) is
equal.

These noises differ by about a third, like estimates from this many equations.
"""
MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""


def whiten_rows(
    columns: np.ndarray,
    weights: np.ndarray,
    sigma: np.ndarray,
    rho: float,
    measured: np.ndarray,
) -> np.ndarray:
    """Return columns (N, d, k), whitened, of the M rows with weight > 0: (dM, k), unit noise.

    Noise that is correlated from row to row is whitened as AR(1), each channel against the inlier
    before it.  Channels that were not measured must be 0 in the columns and stay 0.

    Args:
        columns: in m or rad.
        weights: (N,) weights of the rows; 0 for an outlier.
        sigma: (d,) noise of the channels, m or rad.
        rho: correlation of the noise from one row to the next.
        measured: (N, d) True for the channels that a row measured.
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
    """Return the weights (N,) of the rows: by their stated noise, or 1 for all.

    The stated noise is used if it makes the residual more probable. This is judged by a Laplace
    distribution with an estimated scale in each channel, so outliers and a common factor have
    little influence.

    Args:
        residual: (N, d) m or rad.
        uneven: (N,) stated noise of each row over the usual noise.
        measured: (N, d) True for the channels that a row measured.
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
    """Return (N,) 1.0 for inliers, 0.0 for rows beyond `OUTLIER` robust standard deviations.

    A row is judged by its largest channel, relative to the robust spread of this channel or to the
    known noise, whichever is larger.

    Args:
        residual: (N, d) m or rad.
        measured: (N, d) True for the channels that a row measured; others do not count.
        sigma: (d,) known noise, if any.
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
    """Return the noise (d,) per channel from weighted residuals (N, d), m or rad.

    It is infinite for a channel that no inlier measured.  The other arguments are as in
    `degrees_of_freedom`.
    """
    count = degrees_of_freedom(weights, effective, measured)
    sigma = np.maximum(np.sqrt((weights[:, None] * residual**2).sum(0) / count), 1e-7)
    return np.where(measured[weights > 0].any(0), sigma, np.inf)


def degrees_of_freedom(weights: np.ndarray, effective: float, measured: np.ndarray) -> np.ndarray:
    """Return the degrees of freedom (d,): a channel's inliers less its part of the parameters.

    They are at least 1 if the channel has any inlier.

    Args:
        weights: (N,) weights of the rows; 0 for an outlier.
        effective: number of parameters that the data determine, of all channels together.
        measured: (N, d) True for the channels that a row measured.
    """
    count = measured[weights > 0].sum(0)
    share = count / max(count.sum(), 1.0)
    return np.maximum(count - effective * share, np.clip(count, 1e-12, 1.0))


def channel_medians(values: np.ndarray) -> np.ndarray:
    """Return the medians (d,) of values (N, d) without NaN; 0 for a column of NaN only."""
    if not np.isnan(values).any():
        return np.asarray(np.median(values, axis=0))
    columns = (column[~np.isnan(column)] for column in values.T)
    return np.array([np.median(column) if len(column) else 0.0 for column in columns])


def channel_means(values: np.ndarray) -> np.ndarray:
    """Return the means (d,) of the finite values of (N, d); 0 for a column without any."""
    held = np.isfinite(values)
    return np.asarray(np.where(held, values, 0.0).sum(0) / np.maximum(held.sum(0), 1))
