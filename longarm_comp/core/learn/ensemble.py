"""Training of a predictor: encode, sparrow start, back-propagation, calibration of sigma."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.inputs import Encoding, check_rows, fit_encoding
from longarm_comp.core.learn.network import (
    NetworkShape,
    forward,
    output_jacobian,
    sparrow_start,
    squared_error,
    with_ones,
    xavier_start,
)
from longarm_comp.core.learn.predictor import LearnedGain, Predictor, Provenance
from longarm_comp.core.learn.sparrow import Fitness, SparrowSearch
from longarm_comp.core.learn.training import Fit, back_propagate

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
Start = Callable[[NetworkShape, Fitness, np.random.Generator, SparrowSearch], Array]

_INITS: dict[str, Start] = {
    "ssa": sparrow_start,
    "xavier": lambda shape, fitness, rng, search: xavier_start(shape, rng),
}
_HIDDEN_CHOICES = (8, 12, 17, 24, 34)  # tried in order until the evidence falls by _UNLIKELY
_UNLIKELY = 30.0
_FOLDS = 4
"""Parts of the rows that are left out in turn, to see whether a network helps at all."""
_FEWEST_ROWS = 20
_Z90 = 1.6449


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
    weights: Array | None = None,
    progress: Progress | None = None,
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
        weights: (N,) precision factors of the samples; 0 leaves one out.
        progress: called with (networks trained, largest number of networks).
        provenance: arm, session and model of the predictor; the settings are added.
    """
    q, known = check_rows("train", q, context)
    y, weights = _checked_targets(q, residual, weights)
    if init not in _INITS:
        raise InputError("train", "init", init, f"one of {sorted(_INITS)}")
    if ensemble < 1:
        raise InputError("train", "ensemble", ensemble, "an integer >= 1")
    if hidden is not None and not 1 <= hidden <= 500:
        raise InputError("train", "hidden", hidden, "an integer in 1..500")
    encoding = fit_encoding(q, known, inputs)
    search = SparrowSearch(population, iterations)
    raw = encoding.raw(q, known)
    x = encoding.standardise(raw)
    offset = np.median(y[weights > 0], axis=0)
    scale = float(np.sqrt(np.mean(np.median(np.abs(y - offset)[weights > 0], axis=0) ** 2)))
    scale = max(1.4826 * scale, 1e-9)
    rows = _Rows(x, (y - offset) / scale, weights, init, seed, search)
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
    lower, upper = _ranges(raw)
    draft = Predictor(
        encoding=encoding,
        lower=lower,
        upper=upper,
        weights=np.array([_padded(shape, each.shape, each.weights) for each in fits]),
        hidden=shape.hidden,
        posterior=_padded(shape, fits[0].shape, _leading(fits[0], probe)),
        offset=offset,
        scale=scale,
        noise=np.full(3, scale * float(np.median([each.sigma for each in fits]))),
        widen=np.ones(3),
        variance_limit=np.inf,
        provenance=Provenance(
            origin.arm_hash, origin.session_hash, origin.joint_names,
            {**origin.settings, **settings},
        ),
    )  # fmt: skip
    left, folds = y.copy(), _folds(q, np.random.default_rng([seed, _FOLDS]))
    without = [(fits[0].shape.hidden, 0, ~out) for out in folds]
    networks = rows.fits(without, tell, len(sizes) * starts)
    for one, out in zip(networks, folds, strict=True):
        left[out] -= forward(one.shape, one.weights, with_ones(x[out])) * scale + offset
    tell(len(sizes) * starts + _FOLDS)
    return _calibrated(draft, y, left, x, weights, probe)


@dataclass(frozen=True)
class _Rows:
    """What networks are trained on, and how."""

    x: Array  # x, target: (N, d) inputs and (N, 3) residual, standardised
    target: Array
    weights: Array  # (N,) precision factors
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
        begun = _INITS[self.init](shape, squared_error(shape, x, target), rng, self.search)
        return back_propagate(shape, begun, x, target, self.weights[rows])

    def likeliest(
        self, sizes: Sequence[int], starts: int, tell: Callable[[int], None]
    ) -> list[Fit]:
        """Networks of rising size until the evidence falls, the likeliest first."""
        fits: list[Fit] = []
        for turn, units in enumerate(sizes):
            if (
                turn
                and NetworkShape(self.x.shape[1], units, 3).size > 1.5 * (self.weights > 0).sum()
            ):
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


def _calibrated(
    draft: Predictor, y: Array, left: Array, x: Array, weights: Array, probe: Array
) -> Predictor:
    """With what rows left out of the training say: gain, conformal factors; the variance limit."""
    used = weights > 0
    _, epistemic = draft._mean_and_variance(x)
    score = (np.abs(left) / np.sqrt(epistemic + draft.noise**2))[used]
    level = min(1.0, np.ceil(0.9 * (len(score) + 1)) / len(score))
    widen = np.quantile(score, level, axis=0) / _Z90
    alone = np.quantile(np.abs(y[used]), level, axis=0) / _Z90
    _, variance = draft._mean_and_variance(probe)
    limit = 4.0 * float(np.quantile(variance.max(axis=1), 0.99))
    gain = LearnedGain.of(y[used], left[used])
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


def _ranges(raw: Array) -> tuple[Array, Array]:
    known = np.where(np.isnan(raw).all(axis=0), 0.0, raw)
    return np.nanmin(known, axis=0), np.nanmax(known, axis=0)


def _checked_targets(q: Array, residual: Array, weights: Array | None) -> tuple[Array, Array]:
    y = np.asarray(residual, float)
    if y.shape != (len(q), 3):
        raise InputError("train", "residual", f"shape {y.shape}", f"({len(q)}, 3) in m")
    if not np.isfinite(y).all():
        row = int(np.argwhere(~np.isfinite(y))[0, 0])
        raise InputError("train", f"residual of row {row}", y[row], "finite (drop lost markers)")
    w = np.ones(len(q)) if weights is None else np.asarray(weights, float)
    if w.shape != (len(q),) or not np.isfinite(w).all() or (w < 0).any():
        raise InputError("train", "weights", f"shape {w.shape}", f"({len(q)},), finite, >= 0")
    if (w > 0).sum() < _FEWEST_ROWS:
        raise InputError("train", "samples", int((w > 0).sum()), f">= {_FEWEST_ROWS}")
    return y, w
