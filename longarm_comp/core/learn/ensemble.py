"""Training of a predictor: encode, sparrow start, back-propagation, calibration of sigma.

Back-propagation is Levenberg-Marquardt with the evidence framework (MacKay 1992, Neural Computation
4, 448-472; Foresee and Hagan 1997): each prior precision ``alpha_g`` (one per input: automatic
relevance determination) and the noise precision ``beta`` are re-estimated from the number of well
determined weights ``gamma_g = n_g - alpha_g tr(A^-1)_gg``.

Gross outliers: residuals are taken as Student-t over the ``k`` outputs of a sample, by iteratively
re-weighted least squares with ``u = (nu + k) / (nu + beta |r|^2)``; ``nu`` is picked by likelihood,
so clean data get ``u = 1`` (Gaussian) and no outlier threshold is needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky
from scipy.linalg.lapack import dtrtri
from scipy.special import gammaln

from longarm_comp.core.arm.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.inputs import Encoding, check_rows, fit_encoding
from longarm_comp.core.learn.network import (
    NetworkShape,
    forward,
    normal_equations,
    output_jacobian,
    sparrow_start,
    squared_error,
    with_ones,
    xavier_start,
)
from longarm_comp.core.learn.predictor import LearnedGain, Predictor, Provenance
from longarm_comp.core.learn.sparrow import SparrowSearch
from longarm_comp.core.model.uncertainty import LEVEL

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
    max_steps: int = 150,
) -> Fit:
    """Train from ``start`` (D,) on standardised ``x`` (N, d) and ``y`` (N, k)."""
    x1 = with_ones(x)
    used = float(y.size)
    group = shape.groups()
    members = np.bincount(group).astype(float)
    alpha, beta, tail = np.full(len(members), 0.1), 10.0, _TAILS[-1]
    weights, robust, damping = start.astype(float), np.ones(len(x)), 1e-2
    gamma, settled = members, 0
    matrix, gradient, residual = normal_equations(shape, weights, x1, y, robust)
    for step in range(1, max_steps + 1):
        prior = alpha[group]
        pull = beta * gradient - prior * weights
        curvature = beta * matrix
        diagonal = np.diag(curvature) + prior
        cost = _cost(residual, weights, robust, prior, beta)
        for _ in range(10):
            system = curvature + np.diag(prior + damping * diagonal)
            move = cho_solve(cho_factor(system, check_finite=False), pull, check_finite=False)
            trial = y - forward(shape, weights + move, x1)
            if _cost(trial, weights + move, robust, prior, beta) < cost:
                weights = weights + move
                damping = max(damping / 5.0, 1e-9)
                break
            damping = min(damping * 4.0, 1e8)
        else:
            settled += 1
        residual = y - forward(shape, weights, x1)
        if step > _PLAIN_STEPS:
            tail, robust = _student(residual, beta)
        matrix, gradient, residual = normal_equations(shape, weights, x1, y, robust)
        if step <= _PLAIN_STEPS:
            continue
        before = np.log(beta)
        # Weights of each group that the data determine
        _, inverse = _laplace(matrix, alpha[group], beta)
        variance = np.bincount(group, np.einsum("ij,ij->j", inverse, inverse))
        gamma = np.clip(members - alpha * variance, 1e-3, members)
        alpha = np.clip(gamma / (np.bincount(group, weights**2) + 1e-9), *_ALPHA)
        spread = float(np.sum(robust[:, None] * residual**2))
        beta = max(used - gamma.sum(), 0.02 * used) / max(spread, 1e-12 * used)
        settled = settled + 1 if abs(np.log(beta) - before) < _SETTLED else 0
        if settled >= _SETTLED_STEPS:
            break
    prior = alpha[group]
    factor, inverse = _laplace(matrix, prior, beta)
    evidence = (
        _student_log(beta * np.sum(residual**2, axis=1), tail, shape.outputs)
        + 0.5 * used * np.log(beta)
        - 0.5 * np.sum(prior * weights**2)
        + 0.5 * np.sum(np.log(prior))
        - np.sum(np.log(np.diag(factor)))
        + gammaln(shape.hidden + 1)
        + shape.hidden * np.log(2.0)  # equal optima: hidden units permuted, signs flipped
    )
    return Fit(
        shape, weights, inverse, float(beta**-0.5), robust, alpha[: shape.inputs],
        float(gamma.sum()), float(evidence),
    )  # fmt: skip


def _cost(residual: Array, weights: Array, row: Array, prior: Array, beta: float) -> float:
    value = 0.5 * beta * np.sum(row[:, None] * residual**2) + 0.5 * np.sum(prior * weights**2)
    return float(value)


def _laplace(matrix: Array, prior: Array, beta: float) -> tuple[Array, Array]:
    """Lower triangle L of the posterior's precision, and its inverse."""
    factor = cholesky(beta * matrix + np.diag(prior), lower=True, check_finite=False)
    return factor, dtrtri(factor, lower=1)[0]


def _student(residual: Array, beta: float) -> tuple[float, Array]:
    """The likeliest ``nu`` of the table and the robust weights (N,) for it."""
    k = residual.shape[1]
    square = beta * np.sum(residual**2, axis=1)
    logs = [_student_log(square, tail, k) for tail in _TAILS]
    tail = float(_TAILS[int(np.argmax(logs))])
    return tail, (tail + k) / (tail + square)


def _student_log(square: Array, tail: float, k: int) -> float:
    constant = gammaln((tail + k) / 2) - gammaln(tail / 2) - 0.5 * k * np.log(tail * np.pi)
    return float(np.sum(constant - 0.5 * (tail + k) * np.log1p(square / tail)))


_INITS = ["ssa", "xavier"]
_HIDDEN_CHOICES = (8, 12, 17, 24, 34)  # tried in order until the evidence falls by _UNLIKELY
_UNLIKELY = 30.0
_FOLDS = 4
"""Parts of the rows that are left out in turn, to see whether a network helps at all."""
_FEWEST_ROWS = 20


def train(
    q: Array,
    residual: Array,
    context: Context | None = None,
    *,
    inputs: str = "context",
    init: str = "ssa",
    seed: int = 0,
    population: int = 50,
    iterations: int = 50,
    hidden: int | None = None,
    ensemble: int = 5,
    progress: Callable[[int, int], None] | None = None,
    provenance: Provenance | None = None,
) -> Predictor:
    """Train the paper's SSA-BP on residuals.

    Args:
        q: (N, n) commanded joints, rad and m.
        residual: (N, 3) measured - predicted, m.
        context: circumstances of the rows, as `Session.context` gives them.
        inputs: ``context`` or ``joints`` (the paper's).
        init: ``ssa`` or ``xavier`` (the control).
        seed: the same seed gives the same predictor on the same machine.
        population, iterations: of the sparrow search.
        hidden: hidden units; ``None`` tries several sizes and keeps the likeliest members of any.
        ensemble: members, each from its own start.
        progress: called with (networks trained, largest number of networks).
        provenance: arm, session and model of the predictor; the settings are added.
    """
    q, known = check_rows("train", q, context)
    y = _checked_targets(q, residual)
    if init not in _INITS:
        raise InputError("train", "init", init, f"one of {_INITS}")
    if ensemble < 1:
        raise InputError("train", "ensemble", ensemble, "an integer >= 1")
    if hidden is not None and not 1 <= hidden <= 500:
        raise InputError("train", "hidden", hidden, "an integer in 1..500")
    encoding = fit_encoding(q, known, inputs)
    search = SparrowSearch(population, iterations)
    raw = encoding.raw(q, known)
    x = encoding.standardise(raw)
    offset = np.median(y, axis=0)
    scale = float(np.sqrt(np.mean(np.median(np.abs(y - offset), axis=0) ** 2)))
    scale = max(1.4826 * scale, 1e-9)
    rows = _Rows(x, (y - offset) / scale, init, seed, search)
    sizes = _HIDDEN_CHOICES if hidden is None else (hidden,)
    starts = ensemble if hidden is not None else (ensemble + 1) // 2

    def tell(networks: int) -> None:
        if progress is not None:
            progress(networks, len(sizes) * starts + _FOLDS)

    fits = rows.likeliest(sizes, starts, tell)[:ensemble]
    shape = NetworkShape(x.shape[1], max(each.shape.hidden for each in fits), 3)
    probe = _probe(x, encoding, np.random.default_rng([seed]))
    settings = {
        "inputs": inputs, "init": init, "seed": seed, "population": population,
        "iterations": iterations, "hidden": [each.shape.hidden for each in fits],
        "ensemble": ensemble, "samples": len(q),
    }  # fmt: skip
    origin = provenance or Provenance()
    ranged = np.where(np.isnan(raw).all(axis=0), 0.0, raw)
    draft = Predictor(
        encoding=encoding,
        lower=np.nanmin(ranged, axis=0),
        upper=np.nanmax(ranged, axis=0),
        weights=np.array([_padded(shape, each.shape, each.weights) for each in fits]),
        hidden=shape.hidden,
        posterior=_padded(shape, fits[0].shape, _leading(fits[0], probe)),
        offset=offset,
        scale=scale,
        noise=np.full(3, scale * float(np.median([each.sigma for each in fits]))),
        widen=np.ones(3),
        variance_limit=np.inf,
        provenance=replace(origin, settings={**origin.settings, **settings}),
    )  # fmt: skip
    left, folds = y.copy(), _folds(q, np.random.default_rng([seed, _FOLDS]))
    without = [(fits[0].shape.hidden, 0, ~out) for out in folds]
    networks = rows.fits(without, tell, len(sizes) * starts)
    for one, out in zip(networks, folds, strict=True):
        left[out] -= forward(one.shape, one.weights, with_ones(x[out])) * scale + offset
    tell(len(sizes) * starts + _FOLDS)
    return _calibrated(draft, y, left, x, probe)


@dataclass(frozen=True)
class _Rows:
    """What networks are trained on, and how."""

    x: Array  # x, target: (N, d) inputs and (N, 3) residual, standardised
    target: Array
    init: str  # init, seed, search: as `train` has them
    seed: int
    search: SparrowSearch

    def fits(
        self,
        wanted: Sequence[tuple[int, int, NDArray[np.bool_] | slice]],
        tell: Callable[[int], None],
        done: int,
    ) -> list[Fit]:
        """Networks of some units, starts and rows, on all cores; ``done``: those before them."""
        made: list[Fit] = []
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for one in pool.map(lambda each: self.fit(*each), wanted):
                made.append(one)
                tell(done + len(made))
        return made

    def fit(self, units: int, start: int, rows: NDArray[np.bool_] | slice) -> Fit:
        """One network of so many hidden units, from start number ``start``."""
        shape = NetworkShape(self.x.shape[1], units, 3)
        rng = np.random.default_rng([self.seed, units, start])
        x, target = self.x[rows], self.target[rows]
        if self.init == "ssa":
            begun = sparrow_start(shape, squared_error(shape, x, target), rng, self.search)
        else:
            begun = xavier_start(shape, rng)
        return back_propagate(shape, begun, x, target)

    def likeliest(
        self, sizes: Sequence[int], starts: int, tell: Callable[[int], None]
    ) -> list[Fit]:
        """Networks of rising size until the evidence falls, the likeliest first."""
        fits: list[Fit] = []
        for turn, units in enumerate(sizes):
            if turn and NetworkShape(self.x.shape[1], units, 3).size > 1.5 * len(self.x):
                break
            wanted = [(units, start, slice(None)) for start in range(starts)]
            networks = self.fits(wanted, tell, turn * starts)
            fits += networks
            best = max(each.evidence for each in fits)
            if max(each.evidence for each in networks) < best - _UNLIKELY:
                break
        return sorted(fits, key=lambda each: -each.evidence)


def _folds(q: Array, rng: np.random.Generator) -> list[NDArray[np.bool_]]:
    """(N,) masks of the rows left out together; repeats of a pose stay together."""
    _, pose = np.unique(np.round(q, 6), axis=0, return_inverse=True)
    pose = pose.ravel()
    fold = (rng.permutation(pose.max() + 1) % _FOLDS)[pose]
    return [fold == k for k in range(_FOLDS) if (fold == k).any()]


def _padded(shape: NetworkShape, own: NetworkShape, weights: NDArray[Any]) -> NDArray[Any]:
    """Weights (..., own D) of a smaller network padded to (..., D) with idle hidden units."""
    v, w, b = shape.split(np.arange(shape.size))
    place = np.concatenate((v[:, : own.hidden].ravel(), w[: own.hidden].ravel(), b))
    padded = np.zeros((*weights.shape[:-1], shape.size), dtype=weights.dtype)
    padded[..., place] = weights
    return padded


def _calibrated(draft: Predictor, y: Array, left: Array, x: Array, probe: Array) -> Predictor:
    """With what rows left out of the training say: gain, conformal factors; the variance limit."""
    _, epistemic = draft._mean_and_variance(x)
    score = np.abs(left) / np.sqrt(epistemic + draft.noise**2)
    level = min(1.0, np.ceil(LEVEL * (len(score) + 1)) / len(score))
    normal = NormalDist().inv_cdf(0.5 * (1.0 + LEVEL))  # of either sign
    widen = np.quantile(score, level, axis=0) / normal
    alone = np.quantile(np.abs(y), level, axis=0) / normal
    _, variance = draft._mean_and_variance(probe)
    limit = 4.0 * float(np.quantile(variance.max(axis=1), 0.99))
    gain = LearnedGain.of(y, left)
    return replace(draft, widen=widen, variance_limit=limit, alone=alone, gain=gain)


def _probe(x: Array, encoding: Encoding, rng: np.random.Generator) -> Array:
    """Inputs (2000, d) over the training region: random joints in their box, with the context of
    some training sample."""
    joints = int(np.sum(encoding.kept < encoding.joints))
    probe = x[rng.integers(0, len(x), 2000)].copy()
    low, high = x[:, :joints].min(axis=0), x[:, :joints].max(axis=0)
    probe[:, :joints] = rng.uniform(low, high, (len(probe), joints))
    return probe


def _leading(fit: Fit, probe: Array) -> NDArray[np.float32]:
    """(r, D) leading directions of the posterior. They hold all but 0.5 % of the Laplace variance
    of the outputs over the training region, at a fraction of the cost."""
    flat = output_jacobian(fit.shape, fit.weights, with_ones(probe[:500]))
    flat = flat.reshape(-1, fit.shape.size)
    spread = flat @ fit.posterior.T
    values, vectors = np.linalg.eigh(spread.T @ spread)
    carried = np.cumsum(values[::-1]) / values.sum()
    count = int(np.searchsorted(carried, 0.995)) + 1
    leading = vectors[:, ::-1][:, :count].T @ fit.posterior
    return np.ascontiguousarray(leading, dtype=np.float32)


def _checked_targets(q: Array, residual: Array) -> Array:
    y = np.asarray(residual, float)
    if y.shape != (len(q), 3):
        raise InputError("train", "residual", f"shape {y.shape}", f"({len(q)}, 3) in m")
    if not np.isfinite(y).all():
        row = int(np.argwhere(~np.isfinite(y))[0, 0])
        raise InputError("train", f"residual of row {row}", y[row], "finite (drop lost markers)")
    if len(q) < _FEWEST_ROWS:
        raise InputError("train", "samples", len(q), f">= {_FEWEST_ROWS}")
    return y
