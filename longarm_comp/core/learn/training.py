"""Back-propagation of many networks at once.

It is Levenberg-Marquardt with the evidence framework (MacKay 1992, Neural Computation 4, 448-472;
Foresee and Hagan 1997): each prior precision ``alpha_g`` (one a group of weights: per input,
automatic relevance determination) and the noise precision ``beta`` are re-estimated from the number
of well determined weights ``gamma_g = n_g - alpha_g tr(A^-1)_gg``.

Gross outliers: residuals are taken as Student-t over the ``k`` outputs of a sample, by iteratively
re-weighted least squares with ``u = (nu + k) / (nu + beta |r|^2)``; ``nu`` is picked by likelihood,
so clean data get ``u = 1`` (Gaussian) and no outlier threshold is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from longarm_comp.core.learn.stack import Stack

_TAILS = (2.5, 3.0, 4.0, 6.0, 9.0, 15.0, 30.0, 100.0, 1e4)  # nu; the last is Gaussian
_PLAIN_STEPS = 5  # steps before the evidence and the robust weights join in
_ALPHA = (1e-4, 1e6)
_SETTLED, _SETTLED_STEPS = 7e-4, 8  # change of log beta, and number of successive steps
_TRIES = 10  # of a step, each with more damping


@dataclass(frozen=True)
class Fits:
    """Trained networks in standardised units, the first index."""

    weights: Tensor  # (M, D)
    posterior: Tensor  # (M, D, D) lower-triangular L^-1 with covariance (L^-1)'(L^-1), Laplace
    sigma: Tensor  # (M,) noise sd of an output (core of the Student-t)
    row_weights: Tensor  # (M, N) robust weights, near 0 for outliers
    relevance: Tensor  # (M, G) alpha of each group; large means ignored
    effective: Tensor  # (M,) gamma, well determined weights
    evidence: Tensor  # (M,) log evidence (Laplace), equal optima not counted


@dataclass
class _State:
    """Networks that train, the first index."""

    place: Tensor  # (M,) which of all they are
    x: Tensor  # (M, d, N)
    y: Tensor  # (M, k, N)
    used: Tensor  # (M, N)
    weights: Tensor  # (M, D)
    robust: Tensor  # (M, N)
    alpha: Tensor  # (M, G)
    beta: Tensor  # beta, tail, damping, settled, effective: (M,)
    tail: Tensor
    damping: Tensor
    settled: Tensor
    effective: Tensor
    residual: Tensor  # (M, k, N)

    def take(self, index: Tensor) -> _State:
        return _State(*(getattr(self, f.name)[index] for f in fields(self)))


def back_propagate(
    stack: Stack, start: Tensor, x: Tensor, y: Tensor, used: Tensor, max_steps: int = 150
) -> Fits:
    """Train from ``start`` (M, D).

    Args:
        x, y: (M, d, N) and (M, k, N), standardised.
        used: (M, N) 1, or 0 for a row that a network does not learn.
    """
    full = start.new_ones(len(start))
    state = _State(
        torch.arange(len(start), device=start.device), x, y, used, start, used,
        0.1 * full[:, None].expand(-1, int(stack.groups.max()) + 1), 10.0 * full,
        _TAILS[-1] * full, 1e-2 * full, 0.0 * full, 0.0 * full, y - stack.outputs(start, x),
    )  # fmt: skip
    equations = stack.normal_equations(start, x, state.residual, used)
    parts = []
    for step in range(1, max_steps + 1):
        stuck = _move(stack, state, *equations)
        if step > _PLAIN_STEPS:
            _robust_weights(state)
        equations = stack.normal_equations(state.weights, state.x, state.residual, state.robust)
        if step > _PLAIN_STEPS:
            change = _evidence_step(stack, state, equations[0])
            state.settled = torch.where(change < _SETTLED, state.settled + stuck + 1.0, 0.0)
        done = (state.settled >= _SETTLED_STEPS) | (step == max_steps)
        if done.any():
            parts.append((state.place[done], _fits(stack, state.take(done), equations[0][done])))
            if done.all():
                break
            state, equations = state.take(~done), (equations[0][~done], equations[1][~done])
    order = torch.cat([place for place, _ in parts]).argsort()
    return Fits(*(torch.cat([getattr(p, f.name) for _, p in parts])[order] for f in fields(Fits)))


def _move(stack: Stack, state: _State, matrix: Tensor, gradient: Tensor) -> Tensor:
    """One damped Gauss-Newton step of each network; returns (M,) 1 where none lowers the cost."""
    prior = state.alpha[:, stack.groups]
    pull = state.beta[:, None] * gradient - prior * state.weights
    curvature = state.beta[:, None, None] * matrix
    diagonal = curvature.diagonal(dim1=1, dim2=2) + prior
    before = _cost(state.residual, state.weights, state.robust, prior, state.beta)
    weights, residual, damping = (
        each.clone() for each in (state.weights, state.residual, state.damping)
    )
    open_ = torch.arange(len(pull), device=pull.device)
    for _ in range(_TRIES):
        system = curvature[open_]
        system.diagonal(dim1=1, dim2=2).add_(prior[open_] + damping[open_, None] * diagonal[open_])
        factor, _ = torch.linalg.cholesky_ex(system)
        half = torch.linalg.solve_triangular(factor, pull[open_, :, None], upper=False)
        step = torch.linalg.solve_triangular(factor.mT, half, upper=True)[..., 0]
        there = state.weights[open_] + step
        left = state.y[open_] - stack.outputs(there, state.x[open_])
        cost = _cost(left, there, state.robust[open_], prior[open_], state.beta[open_])
        lower = cost < before[open_]
        good, open_ = open_[lower], open_[~lower]
        weights[good], residual[good] = there[lower], left[lower]
        damping[good] = (damping[good] / 5.0).clamp(min=1e-9)
        if not len(open_):
            break
        damping[open_] = (damping[open_] * 4.0).clamp(max=1e8)
    state.weights, state.residual, state.damping = weights, residual, damping
    return torch.zeros_like(state.beta).index_fill(0, open_, 1.0)


def _cost(residual: Tensor, weights: Tensor, row: Tensor, prior: Tensor, beta: Tensor) -> Tensor:
    square = (residual.square().sum(1) * row).sum(1)
    return 0.5 * (beta * square + (prior * weights.square()).sum(1))


def _robust_weights(state: _State) -> None:
    """The likeliest ``nu`` of the table and the weights of the rows for it."""
    k, tails = state.residual.shape[1], state.beta.new_tensor(_TAILS)
    square = state.beta[:, None] * state.residual.square().sum(1)
    logs = _student_log(square, tails.expand(len(square), -1), state.used, k)
    state.tail = tails[logs.argmax(1)]
    tail = state.tail[:, None]
    state.robust = (tail + k) / (tail + square) * state.used


def _student_log(square: Tensor, nu: Tensor, used: Tensor, k: int) -> Tensor:
    """Log likelihood (M, T) of squared residuals (M, N) in units of the noise, by tails (M, T)."""
    half = 0.5 * (nu + k)
    constant = torch.lgamma(half) - torch.lgamma(nu / 2) - 0.5 * k * (nu * math.pi).log()
    logs = torch.log1p(square[:, None] / nu[..., None]) @ used[..., None]
    return constant * used.sum(1, keepdim=True) - half * logs[..., 0]


def _laplace(state: _State, matrix: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Lower triangle L of the posterior's precision, and its inverse."""
    precision = state.beta[:, None, None] * matrix
    precision.diagonal(dim1=1, dim2=2).add_(prior)
    factor = torch.linalg.cholesky(precision)
    return factor, _inverse(factor)


def _inverse(lower: Tensor) -> Tensor:
    """Of lower triangles (M, D, D). In halves: half of a right-hand side of ones is zeros."""
    size = lower.shape[1]
    if size <= 96:
        eye = torch.eye(size, dtype=lower.dtype, device=lower.device)
        return torch.linalg.solve_triangular(lower, eye, upper=False)
    first, second = slice(0, size // 2), slice(size // 2, size)
    inverse = torch.zeros_like(lower)
    inverse[:, first, first] = left = _inverse(lower[:, first, first])
    inverse[:, second, second] = right = _inverse(lower[:, second, second])
    inverse[:, second, first] = -right @ (lower[:, second, first] @ left)
    return inverse


def _evidence_step(stack: Stack, state: _State, matrix: Tensor) -> Tensor:
    """Re-estimate alpha, beta and the effective weights; returns the change of log beta (M,)."""
    _, inverse = _laplace(state, matrix, state.alpha[:, stack.groups])

    def by_group(each: Tensor) -> Tensor:
        return torch.zeros_like(state.alpha).index_add(1, stack.groups, each)

    count = torch.bincount(stack.groups)
    variance = by_group(inverse.square().sum(dim=1))
    gamma = torch.minimum((count - state.alpha * variance).clamp(min=1e-3), count)
    state.alpha = (gamma / (by_group(state.weights.square()) + 1e-9)).clamp(*_ALPHA)
    state.effective, before = gamma.sum(1), state.beta
    spread = (state.residual.square().sum(1) * state.robust).sum(1)
    used = state.used.sum(1) * state.residual.shape[1]
    free = torch.maximum(used - state.effective, 0.02 * used)
    state.beta = free / torch.maximum(spread, 1e-12 * used)
    return (state.beta / before).log().abs()


def _fits(stack: Stack, state: _State, matrix: Tensor) -> Fits:
    prior, k = state.alpha[:, stack.groups], state.residual.shape[1]
    factor, inverse = _laplace(state, matrix, prior)
    square = state.beta[:, None] * state.residual.square().sum(1)
    evidence = (
        _student_log(square, state.tail[:, None], state.used, k)[:, 0]
        + 0.5 * k * state.used.sum(1) * state.beta.log()
        - 0.5 * (prior * state.weights.square()).sum(1)
        + 0.5 * prior.log().sum(1)
        - factor.diagonal(dim1=1, dim2=2).log().sum(1)
    )
    return Fits(
        state.weights, inverse, state.beta**-0.5, state.robust, state.alpha, state.effective,
        evidence,
    )  # fmt: skip
