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
_TRIES = 5  # of a step, each with more damping


@dataclass(frozen=True)
class Samples:
    """What each of M networks learns, standardised."""

    x: Tensor  # (M, d, N)
    y: Tensor  # (M, k, N)
    used: Tensor  # (M, N) 1, or 0 where a network has fewer rows


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

    def take(self, index: Tensor) -> Fits:
        return Fits(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def join(cls, parts: list[Fits]) -> Fits:
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass
class _Going:
    """Networks that still train, the first index."""

    place: Tensor  # (M,) which of all they are
    x: Tensor
    y: Tensor
    used: Tensor
    groups: Tensor  # (M, D, G) 1 for the group of a weight, 0 of an idle one
    idle: Tensor  # (M, D) 1 for an idle weight
    weights: Tensor
    robust: Tensor  # (M, N)
    alpha: Tensor  # (M, G)
    beta: Tensor  # (M,)
    tail: Tensor  # (M,)
    damping: Tensor  # (M,)
    settled: Tensor  # (M,)
    matrix: Tensor
    gradient: Tensor
    residual: Tensor

    def take(self, index: Tensor) -> _Going:
        return _Going(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def prior(self) -> Tensor:
        """(M, D) alpha of each weight; 1 of an idle one, which adds nothing to the evidence."""
        return (self.groups @ self.alpha[..., None])[..., 0] + self.idle

    def by_group(self, each: Tensor) -> Tensor:
        """Sums (M, G) of values (M, D)."""
        return (each[:, None] @ self.groups)[:, 0]


def back_propagate(
    stack: Stack, start: Tensor, samples: Samples, busy: Tensor, max_steps: int = 150
) -> Fits:
    """Train from ``start`` (M, D), whose weights that are not ``busy`` are 0 and stay it."""
    groups = torch.nn.functional.one_hot(stack.groups).to(start) * busy[..., None]
    full = start.new_ones(len(start))
    state = _Going(
        torch.arange(len(start), device=start.device), samples.x, samples.y, samples.used,
        groups, (~busy).to(start), start, samples.used, 0.1 * torch.ones_like(groups[:, 0]),
        10.0 * full, _TAILS[-1] * full, 1e-2 * full, 0.0 * full,
        *stack.normal_equations(start, samples.x, samples.y, samples.used),
    )  # fmt: skip
    parts: list[tuple[Tensor, Fits]] = []
    for step in range(1, max_steps + 1):
        stuck = _move(stack, state)
        if step > _PLAIN_STEPS:
            _robust_weights(state)
        state.matrix, state.gradient, state.residual = stack.normal_equations(
            state.weights, state.x, state.y, state.robust
        )
        if step <= _PLAIN_STEPS:
            continue
        _, inverse = _laplace(state)
        gamma, change = _evidence_step(state, inverse)
        state.settled = torch.where(change < _SETTLED, state.settled + stuck + 1.0, 0.0)
        done = (state.settled >= _SETTLED_STEPS) | (step == max_steps)
        if done.any():
            ended = state.take(done)
            parts.append((ended.place, _fits(ended, gamma[done])))
            if done.all():
                break
            state = state.take(~done)
    order = torch.cat([place for place, _ in parts]).argsort()
    return Fits.join([fits for _, fits in parts]).take(order)


def _move(stack: Stack, state: _Going) -> Tensor:
    """One damped Gauss-Newton step of each network; returns (M,) 1 where none lowers the cost."""
    prior = state.prior
    pull = state.beta[:, None] * state.gradient - prior * state.weights
    curvature = state.beta[:, None, None] * state.matrix
    diagonal = curvature.diagonal(dim1=1, dim2=2) + prior
    before = _cost(state.residual, state.weights, state.robust, prior, state.beta)
    open_ = torch.arange(len(pull), device=pull.device)
    weights, damping, residual = (
        state.weights.clone(),
        state.damping.clone(),
        state.residual.clone(),
    )
    for _ in range(_TRIES):
        each = open_.repeat_interleave(2)  # two dampings at once: every other step needs the second
        damped = (damping[open_, None] * damping.new_tensor((1.0, 4.0))).flatten()
        system = curvature[each]
        system.diagonal(dim1=1, dim2=2).add_(prior[each] + damped[:, None] * diagonal[each])
        factor, _ = torch.linalg.cholesky_ex(system)
        there = weights[each] + torch.cholesky_solve(pull[each, :, None], factor)[..., 0]
        left = state.y[each] - stack.outputs(there, state.x[each])
        cost = _cost(left, there, state.robust[each], prior[each], state.beta[each])
        best, second = cost.nan_to_num(nan=torch.inf).view(-1, 2).min(dim=1)
        lower = best < before[open_]
        pick = (2 * torch.arange(len(open_), device=open_.device) + second)[lower]
        good, open_ = open_[lower], open_[~lower]
        weights[good], residual[good] = there[pick], left[pick]
        damping[good] = (damped[pick] / 5.0).clamp(min=1e-9)
        if not len(open_):
            break
        damping[open_] = (damping[open_] * 16.0).clamp(max=1e8)
    state.weights, state.damping, state.residual = weights, damping, residual
    stuck = torch.zeros_like(state.beta)
    stuck[open_] = 1.0
    return stuck


def _cost(residual: Tensor, weights: Tensor, row: Tensor, prior: Tensor, beta: Tensor) -> Tensor:
    square = (residual.square().sum(1) * row).sum(1)
    return 0.5 * (beta * square + (prior * weights.square()).sum(1))


def _robust_weights(state: _Going) -> None:
    """The likeliest ``nu`` of the table and the weights of the rows for it."""
    k, tails = state.y.shape[1], state.beta.new_tensor(_TAILS)
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


def _laplace(state: _Going) -> tuple[Tensor, Tensor]:
    """Lower triangle L of the posterior's precision, and its inverse."""
    precision = state.beta[:, None, None] * state.matrix
    precision.diagonal(dim1=1, dim2=2).add_(state.prior)
    factor = torch.linalg.cholesky(precision)
    eye = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
    return factor, torch.linalg.solve_triangular(factor, eye, upper=False)


def _evidence_step(state: _Going, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Re-estimate alpha and beta; gamma (M, G) and the change of log beta (M,)."""
    count = state.groups.sum(dim=1)
    variance = state.by_group(inverse.square().sum(dim=1))
    gamma = torch.minimum((count - state.alpha * variance).clamp(min=1e-3), count)
    square = state.by_group(state.weights.square())
    state.alpha = (gamma / (square + 1e-9)).clamp(*_ALPHA)
    spread = (state.residual.square().sum(1) * state.robust).sum(1)
    used, before = state.used.sum(1) * state.y.shape[1], state.beta
    free = torch.maximum(used - gamma.sum(1), 0.02 * used)
    state.beta = free / torch.maximum(spread, 1e-12 * used)
    return gamma, (state.beta / before).log().abs()


def _fits(state: _Going, gamma: Tensor) -> Fits:
    prior, k = state.prior, state.y.shape[1]
    factor, inverse = _laplace(state)
    square = state.beta[:, None] * state.residual.square().sum(1)
    evidence = (
        _student_log(square, state.tail[:, None], state.used, k)[:, 0]
        + 0.5 * k * state.used.sum(1) * state.beta.log()
        - 0.5 * (prior * state.weights.square()).sum(1)
        + 0.5 * prior.log().sum(1)
        - factor.diagonal(dim1=1, dim2=2).log().sum(1)
    )
    return Fits(
        state.weights, inverse, state.beta**-0.5, state.robust, state.alpha, gamma.sum(1), evidence
    )
