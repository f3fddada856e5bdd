"""Back-propagation by Levenberg-Marquardt; the evidence framework sets the regularisation.

MacKay (1992), Neural Computation 4, 448-472, and Foresee and Hagan (1997): each prior precision
``alpha_g`` (one per input: automatic relevance determination) and the noise precision ``beta`` are
re-estimated from the number of well determined weights ``gamma_g = n_g - alpha_g tr(A^-1)_gg``.

Gross outliers: residuals are taken as Student-t over the ``k`` outputs of a sample, by iteratively
re-weighted least squares with ``u = (nu + k) / (nu + beta |r|^2)``; ``nu`` is picked by likelihood,
so clean data get ``u = 1`` (Gaussian) and no outlier threshold is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky
from scipy.linalg.lapack import dtrtri
from scipy.special import gammaln

from longarm_comp.core.learn.network import NetworkShape, forward, normal_equations, with_ones

Array = NDArray[np.float64]

_TAILS = np.array([2.5, 3.0, 4.0, 6.0, 9.0, 15.0, 30.0, 100.0, 1e4])  # nu; the last is Gaussian
_PLAIN_STEPS = 5  # steps before the evidence and the robust weights join in
_ALPHA = (1e-4, 1e6)
_SETTLED, _SETTLED_STEPS = 7e-4, 8  # change of log beta, and number of successive steps


@dataclass(frozen=True)
class Fit:
    """A trained network in standardised units."""

    shape: NetworkShape
    weights: Array  # (D,)
    posterior: Array  # (D, D) lower-triangular L^-1 with covariance (L^-1)'(L^-1), Laplace
    sigma: float  # noise sd of an output (core of the Student-t)
    row_weights: Array  # (N,) robust weights, near 0 for outliers
    relevance: Array  # (d,) alpha of each input; large means ignored
    effective: float  # gamma, well determined weights
    evidence: float  # log evidence (Laplace)


def back_propagate(
    shape: NetworkShape,
    start: Array,
    x: Array,
    y: Array,
    sample_weights: Array | None = None,
    max_steps: int = 150,
) -> Fit:
    """Train from ``start`` (D,) on standardised ``x`` (N, d) and ``y`` (N, k).

    ``sample_weights`` (N,) multiply the precision of a sample; 0 leaves it out.
    """
    x1 = with_ones(x)
    count = np.ones(len(x)) if sample_weights is None else np.asarray(sample_weights, float)
    used = float((count > 0).sum()) * shape.outputs
    group = shape.groups()
    members = np.bincount(group).astype(float)
    alpha, beta, tail = np.full(len(members), 0.1), 10.0, _TAILS[-1]
    weights, robust, damping = start.astype(float), np.ones(len(x)), 1e-2
    gamma, settled = members, 0
    matrix, gradient, residual = normal_equations(shape, weights, x1, y, count * robust)
    for step in range(1, max_steps + 1):
        prior = alpha[group]
        pull = beta * gradient - prior * weights
        curvature = beta * matrix
        diagonal = np.diag(curvature) + prior
        cost = _cost(residual, weights, count * robust, prior, beta)
        for _ in range(10):
            system = curvature + np.diag(prior + damping * diagonal)
            move = cho_solve(cho_factor(system, check_finite=False), pull, check_finite=False)
            trial = y - forward(shape, weights + move, x1)
            if _cost(trial, weights + move, count * robust, prior, beta) < cost:
                weights = weights + move
                damping = max(damping / 5.0, 1e-9)
                break
            damping = min(damping * 4.0, 1e8)
        else:
            settled += 1
        residual = y - forward(shape, weights, x1)
        if step > _PLAIN_STEPS:
            tail, robust = _student(residual, beta, count)
        matrix, gradient, residual = normal_equations(shape, weights, x1, y, count * robust)
        if step <= _PLAIN_STEPS:
            continue
        before = np.log(beta)
        # Weights of each group that the data determine
        _, inverse = _laplace(matrix, alpha[group], beta)
        variance = np.bincount(group, np.einsum("ij,ij->j", inverse, inverse))
        gamma = np.clip(members - alpha * variance, 1e-3, members)
        alpha = np.clip(gamma / (np.bincount(group, weights**2) + 1e-9), *_ALPHA)
        spread = float(np.sum((count * robust)[:, None] * residual**2))
        beta = max(used - gamma.sum(), 0.02 * used) / max(spread, 1e-12 * used)
        settled = settled + 1 if abs(np.log(beta) - before) < _SETTLED else 0
        if settled >= _SETTLED_STEPS:
            break
    prior = alpha[group]
    factor, inverse = _laplace(matrix, prior, beta)
    square = beta * count * np.sum(residual**2, axis=1)
    evidence = (
        _student_log(square[count > 0], tail, shape.outputs)
        + 0.5 * shape.outputs * np.sum(np.log(beta * count[count > 0]))
        - 0.5 * np.sum(prior * weights**2)
        + 0.5 * np.sum(np.log(prior))
        - np.sum(np.log(np.diag(factor)))
        + gammaln(shape.hidden + 1)
        + shape.hidden * np.log(2.0)  # equal optima: hidden units permuted, signs flipped
    )
    relevance = alpha[: shape.inputs]
    return Fit(
        shape, weights, inverse, float(beta**-0.5), robust, relevance, float(gamma.sum()),
        float(evidence),
    )  # fmt: skip


def _cost(residual: Array, weights: Array, row: Array, prior: Array, beta: float) -> float:
    value = 0.5 * beta * np.sum(row[:, None] * residual**2) + 0.5 * np.sum(prior * weights**2)
    return float(value)


def _laplace(matrix: Array, prior: Array, beta: float) -> tuple[Array, Array]:
    """Lower triangle L of the posterior's precision, and its inverse."""
    factor = cholesky(beta * matrix + np.diag(prior), lower=True, check_finite=False)
    return factor, dtrtri(factor, lower=1)[0]


def _student(residual: Array, beta: float, count: Array) -> tuple[float, Array]:
    """The likeliest ``nu`` of the table and the robust weights (N,) for it."""
    k = residual.shape[1]
    square = beta * count * np.sum(residual**2, axis=1)
    used = square[count > 0]
    logs = [_student_log(used, tail, k) for tail in _TAILS]
    tail = float(_TAILS[int(np.argmax(logs))])
    return tail, (tail + k) / (tail + square)


def _student_log(square: Array, tail: float, k: int) -> float:
    constant = gammaln((tail + k) / 2) - gammaln(tail / 2) - 0.5 * k * np.log(tail * np.pi)
    return float(np.sum(constant - 0.5 * (tail + k) * np.log1p(square / tail)))
