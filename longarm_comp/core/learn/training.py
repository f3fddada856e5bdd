"""Back-propagation of many networks at once.

It is Levenberg-Marquardt with the evidence framework (MacKay 1992, Neural Computation 4, 448-472;
Foresee and Hagan 1997): each prior precision ``alpha_g`` (one a group of weights: per input,
automatic relevance determination) and the noise precision ``beta`` are re-estimated from the number
of well determined weights ``gamma_g = n_g - alpha_g tr(A^-1)_gg``. The damping follows the ratio of
the gain to the predicted one (Nielsen 1999, IMM-REP-1999-05).

Gross outliers: residuals are taken as Student-t over the ``k`` outputs of a sample, by iteratively
re-weighted least squares with ``u = (nu + k) / (nu + beta |r|^2)``; ``nu`` is picked by likelihood,
so clean data get ``u = 1`` (Gaussian) and no outlier threshold is needed.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from longarm_comp.core.learn.stack import Stack

_TAILS = (2.5, 3.0, 4.0, 6.0, 9.0, 15.0, 30.0, 100.0, 1e4)  # nu; the last is Gaussian
_PLAIN_STEPS = 8  # steps before the evidence and the robust weights join in
_ALPHA = (1e-4, 1e6)
_SETTLED, _SETTLED_STEPS = 7e-4, 8  # change of log beta, and number of successive steps


@dataclass
class Networks:
    """M networks and the state of their training, in standardised units."""

    place: Tensor  # (M,) their numbers among all that are trained
    x: Tensor  # (M, N, d)
    y: Tensor  # (M, N, k)
    used: Tensor  # (M, N) 1, or 0 for a row that a network does not learn
    weights: Tensor  # (M, D)
    residual: Tensor  # (M, N, k)
    robust: Tensor  # (M, N) weights of the rows, near 0 for outliers
    tail: Tensor  # (M,) nu
    alpha: Tensor  # (M, G) relevance: large means that a group is ignored
    beta: Tensor  # (M,) precision of the noise of an output (core of the Student-t)
    effective: Tensor  # (M,) gamma, well determined weights
    damping: Tensor  # (M,)
    settled: Tensor  # (M,) successive steps without much change
    matrix: Tensor  # (M, D, D), (M, D): normal equations
    gradient: Tensor

    def square(self) -> Tensor:
        """Return ``beta |r|^2`` (M, N)."""
        return self.beta[:, None] * self.residual.square().sum(2)


@dataclass
class Fits(Networks):
    """The networks after their training, with posterior and evidence."""

    root: Tensor  # (M, D, D) lower-triangular R with the posterior's covariance R'R (Laplace)
    evidence: Tensor  # (M,) log evidence (Laplace), equal optima not counted


def back_propagate(
    stack: Stack, start: Tensor, x: Tensor, y: Tensor, used: Tensor, max_steps: int = 150
) -> Fits:
    """Train from ``start`` (M, D) on rows as in `Networks`."""
    one = start.new_ones(len(start))
    left, groups = y - stack.outputs(start, x), int(stack.groups.max()) + 1
    tails, outputs = one.new_tensor(_TAILS), y.shape[2]
    going = Networks(
        torch.arange(len(one), device=one.device),
        x,
        y,
        used,
        start,
        left,
        used,
        _TAILS[-1] * one,
        0.1 * one[:, None].expand(-1, groups),
        10.0 * one,
        0.0 * one,
        1e-2 * one,
        0.0 * one,
        *stack.normal_equations(start, x, left, used),
    )
    ended = list[list[Tensor]]()
    for step in range(1, max_steps + 1):
        moved = _try_step(stack, going)
        if step > _PLAIN_STEPS:  # the likeliest ``nu``, and the weights of the rows for it
            square = going.square()
            logs = _student_log(square, tails.expand(len(square), -1), going.used, outputs)
            going.tail = tails[logs.argmax(1)]
            nu = going.tail[:, None]
            going.robust = (nu + outputs) / (nu + square) * going.used
        state = going.weights, going.x, going.residual, going.robust
        going.matrix, going.gradient = stack.normal_equations(*state)
        if step > _PLAIN_STEPS:
            change = _estimate_precisions(stack, going)
            settled = torch.where(change < _SETTLED, going.settled + 1.0, 0.0)
            going.settled = torch.where(moved, settled, going.settled)
        done = (going.settled >= _SETTLED_STEPS) | (step == max_steps)
        if done.any():
            ended.append([each[done] for each in vars(going).values()])
            going = Networks(*(each[~done] for each in vars(going).values()))
            if done.all():
                break
    parts = [torch.cat(each) for each in zip(*ended, strict=True)]
    order = parts[0].argsort()
    return _evaluate_fits(stack, Networks(*(each[order] for each in parts)))


def _try_step(stack: Stack, at: Networks) -> Tensor:
    """Try a damped Gauss-Newton step of each network; return (M,) True where it was taken."""
    prior = at.alpha[:, stack.groups]
    pull = at.beta[:, None] * at.gradient - prior * at.weights
    system = at.beta[:, None, None] * at.matrix
    diagonal = system.diagonal(dim1=1, dim2=2)
    damped = at.damping[:, None] * (diagonal + prior)
    diagonal.add_(prior + damped)
    factor, _ = torch.linalg.cholesky_ex(system)
    step = torch.cholesky_solve(pull[..., None], factor)[..., 0]
    weights = at.weights + step
    left = at.y - stack.outputs(weights, at.x)
    before = _compute_cost(at, at.residual, at.weights, prior)
    gained = before - _compute_cost(at, left, weights, prior)
    ratio = gained / (0.5 * (step * (pull + damped * step)).sum(1))
    good = gained > -1e-9 * before  # rounding is no reason to stay
    shrink = (1.0 - (2.0 * ratio.clamp(0.0, 1.0) - 1.0) ** 3).clamp(min=0.2)
    at.damping = (at.damping * torch.where(good, shrink, 4.0)).clamp(1e-9, 1e8)
    at.weights = torch.where(good[:, None], weights, at.weights)
    at.residual = torch.where(good[:, None, None], left, at.residual)
    return good


def _compute_cost(at: Networks, residual: Tensor, weights: Tensor, prior: Tensor) -> Tensor:
    square = (residual.square().sum(2) * at.robust).sum(1)
    return 0.5 * (at.beta * square + (prior * weights.square()).sum(1))


def _student_log(square: Tensor, nu: Tensor, used: Tensor, k: int) -> Tensor:
    """Return the log likelihood (M, T) of squared residuals (M, N) for tails ``nu`` (M, T).

    The residuals are in units of the noise and have `k` components.
    """
    half = 0.5 * (nu + k)
    constant = torch.lgamma(half) - torch.lgamma(nu / 2) - 0.5 * k * (nu * math.pi).log()
    logs = torch.log1p(square[:, None] / nu[..., None]) @ used[..., None]
    return constant * used.sum(1, keepdim=True) - half * logs[..., 0]


def _factor_precision(stack: Stack, at: Networks) -> Tensor:
    """Return the lower triangle L of the posterior's precision ``A = L L'``."""
    precision = at.beta[:, None, None] * at.matrix
    precision.diagonal(dim1=1, dim2=2).add_(at.alpha[:, stack.groups])
    return torch.linalg.cholesky(precision)


def _estimate_precisions(stack: Stack, at: Networks) -> Tensor:
    """Estimate alpha, beta and the effective weights anew; return the change of log beta (M,)."""

    def by_group(each: Tensor) -> Tensor:
        return torch.zeros_like(at.alpha).index_add(1, stack.groups, each)

    covariance = torch.cholesky_inverse(_factor_precision(stack, at))
    count = by_group(torch.ones_like(at.weights))
    determined = count - at.alpha * by_group(covariance.diagonal(dim1=1, dim2=2))
    gamma = torch.minimum(determined.clamp(min=1e-3), count)
    at.alpha = (gamma / (by_group(at.weights.square()) + 1e-9)).clamp(*_ALPHA)
    at.effective, before = gamma.sum(1), at.beta
    spread = (at.residual.square().sum(2) * at.robust).sum(1)
    seen = at.used.sum(1) * at.y.shape[2]
    at.beta = torch.maximum(seen - at.effective, 0.02 * seen) / torch.maximum(spread, 1e-12 * seen)
    return (at.beta / before).log().abs()


def _evaluate_fits(stack: Stack, at: Networks) -> Fits:
    prior, k, factor = at.alpha[:, stack.groups], at.y.shape[2], _factor_precision(stack, at)
    evidence = (
        _student_log(at.square(), at.tail[:, None], at.used, k)[:, 0]
        + 0.5 * k * at.used.sum(1) * at.beta.log()
        - 0.5 * (prior * at.weights.square()).sum(1)
        + 0.5 * prior.log().sum(1)
        - factor.diagonal(dim1=1, dim2=2).log().sum(1)
    )
    one = torch.eye(stack.size, dtype=factor.dtype, device=factor.device)
    root = torch.linalg.solve_triangular(factor, one, upper=False)
    return Fits(**vars(at), root=root, evidence=evidence)
