"""Training of a predictor: encode, train an ensemble, judge it at rows left out, scale sigma."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.arm.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.inputs import check_rows, fit_encoding
from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.predictor import LearnedGain, Predictor, Provenance
from longarm_comp.core.model.uncertainty import LEVEL

if TYPE_CHECKING:
    from longarm_comp.core.learn.others import NetworkKind

Array = NDArray[np.float64]

_HIDDEN_CHOICES = (8, 12, 17, 24, 34)  # tried in order until the evidence falls by _UNLIKELY
_UNLIKELY = 15.0
_FOLDS = 4
"""Parts of the rows that are left out in turn, to see whether a network helps at all."""
_FEWEST_ROWS = 20


def train(
    q: Array,
    residual: Array,
    context: Context | None = None,
    *,
    inputs: str = "context",
    init: str | None = None,
    seed: int = 0,
    population: int = 50,
    iterations: int = 50,
    hidden: int | None = None,
    ensemble: int = 5,
    device: str = "auto",
    network: NetworkKind | None = None,
    progress: Callable[[int, int], None] | None = None,
    provenance: Provenance | None = None,
) -> Predictor:
    """Train the paper's SSA-BP on residuals.

    Args:
        q: (N, n) commanded joints, rad and m.
        residual: (N, 3) measured - predicted, m.
        context: circumstances of the rows, as `Session.context` gives them.
        inputs: ``context`` or ``joints`` (the paper's).
        init: ``ssa`` (the default) or ``xavier`` (the control).
        seed: the same seed gives the same predictor on the same machine.
        population, iterations: of the sparrow search.
        hidden: number of hidden units; ``None`` tries several and keeps the likeliest networks.
        ensemble: number of networks in the predictor, each from its own initial weights.
        device: where torch trains: ``cpu``, ``cuda``, or ``auto``: a GPU where there is one.
        network: a network to train instead of the paper's (docs/your_own_network.md).
        progress: called with (networks trained, largest number of networks).
        provenance: arm, session and model of the predictor; the settings are added.

    Raises:
        InputError: fewer than 20 rows, a wrong shape or value, rows of one pose, or no GPU for
            ``cuda``.
    """
    q, known = check_rows("train", q, context)
    y = np.asarray(residual, float)
    if y.shape != (len(q), 3):
        raise InputError("train", "residual", f"shape {y.shape}", f"({len(q)}, 3) in m")
    if not np.isfinite(y).all():
        row = int(np.argwhere(~np.isfinite(y))[0, 0])
        raise InputError("train", f"residual of row {row}", y[row], "finite (drop lost markers)")
    if len(q) < _FEWEST_ROWS:
        raise InputError("train", "samples", len(q), f">= {_FEWEST_ROWS}")
    for name, given, fine, allowed in (
        ("init", init, init in (None, "ssa", "xavier"), "ssa or xavier"),
        ("hidden", hidden, hidden is None or 1 <= hidden <= 500, "an integer in 1..500"),
        ("ensemble", ensemble, ensemble >= 1, "an integer >= 1"),
        ("device", device, device in ("auto", "cpu", "cuda"), "auto, cpu or cuda"),
    ):
        if not fine:
            raise InputError("train", name, given, allowed)
        if network and name in ("init", "hidden") and given is not None:
            raise InputError("train", name, given, f"none: {network.name} has its own")
    encoding = fit_encoding(q, known, inputs)
    _, x = encoding.encode(q, known)
    offset = np.median(y, axis=0)
    scale = float(np.sqrt(np.mean(np.median(np.abs(y - offset), axis=0) ** 2)))
    scale = max(1.4826 * scale, 1e-9)
    learner = _Learner(
        x, (y - offset) / scale, init or "ssa", seed, (population, iterations), network, device
    )
    sizes = (0,) if network else _HIDDEN_CHOICES if hidden is None else (hidden,)
    starts = ensemble if len(sizes) == 1 else (ensemble + 1) // 2

    def tell(networks: int) -> None:
        if progress is not None:
            progress(networks, len(sizes) * starts + _FOLDS)

    fits = learner.find_likeliest(sizes, starts, tell)[:ensemble]
    out = _draw_folds(q, np.random.default_rng([seed, _FOLDS]))
    without = learner.train_batch(fits[0].units, ~out)
    tell(len(sizes) * starts + _FOLDS)
    shape = NetworkShape(x.shape[1], max(each.units for each in fits), 3)
    settings = {
        "inputs": inputs,
        "init": init or ("own" if network else "ssa"),
        "seed": seed,
        "population": population,
        "iterations": iterations,
        "hidden": [f.units for f in fits],
        "ensemble": ensemble,
        "samples": len(q),
    }
    origin = provenance or Provenance()
    draft = Predictor(
        encoding=encoding,
        weights=np.array([each.pad(shape, each.weights) for each in fits]),
        hidden=shape.hidden,
        posterior=np.zeros((1, shape.size), np.float32),
        offset=offset,
        scale=scale,
        noise=np.full(3, scale * float(np.median([each.sigma for each in fits]))),
        widen=np.ones(3),
        variance_limit=np.inf,
        provenance=replace(origin, settings={**origin.settings, **settings}),
        network=network,
    )
    # Inputs all over the training region: random joints, circumstances of random rows
    rng, joints = np.random.default_rng([seed]), int(encoding.is_joint.sum())
    probe = x[rng.integers(0, len(x), 2000)]
    low, high = x[:, :joints].min(axis=0), x[:, :joints].max(axis=0)
    probe[:, :joints] = rng.uniform(low, high, (len(probe), joints))
    root = fits[0].pad(shape, fits[0].root)
    draft = replace(draft, posterior=_find_leading_directions(draft, root, probe))
    left = y.copy()
    for one, rows in zip(without, out, strict=True):
        alone = replace(draft, weights=one.pad(shape, one.weights)[None])
        left[rows] -= alone.members.outputs(x[rows])[0] * scale + offset
    return _calibrate(draft, y, left, x, probe)


@dataclass(frozen=True)
class _Fit:
    """One trained network, in standardised units."""

    units: int  # hidden; 0: a foreign network
    weights: Array  # (D,)
    sigma: float
    evidence: float
    root: Array  # (D, D) R of the covariance R'R of the weights

    def pad(self, shape: NetworkShape, weights: Array) -> Array:
        """Pad weights (..., own D) with idle hidden units to a larger network's (..., D)."""
        if not self.units:
            return weights
        padded = np.zeros((*weights.shape[:-1], shape.size))
        padded[..., replace(shape, hidden=self.units).within(shape)] = weights
        return padded


@dataclass(frozen=True)
class _Learner:
    """The rows that networks are trained on, and the settings of the training."""

    x: Array  # x, target: (N, d) inputs and (N, 3) residual, standardised
    target: Array
    init: str  # init, seed, device: as `train` has them
    seed: int
    search: tuple[int, int]  # population, iterations
    network: NetworkKind | None
    device: str

    def train_batch(self, units: int, rows: NDArray[np.bool_]) -> list[_Fit]:
        """Train M networks with `units` hidden units as one batch, each on its `rows` (M, N)."""
        import torch

        from longarm_comp.core.learn.sparrow import SparrowSearch
        from longarm_comp.core.learn.stack import TanhStack
        from longarm_comp.core.learn.training import back_propagate

        there = torch.cuda.is_available()
        if self.device == "cuda" and not there:
            allowed = f"cpu: torch {torch.__version__} sees no GPU"
            raise InputError("train", "device", self.device, allowed)
        device = torch.device("cuda" if there and self.device != "cpu" else "cpu")
        most = int(rows.sum(axis=1).max())  # rows of fewer are filled up with ones not used
        own = np.argsort(~rows, axis=1, kind="stable")[:, :most]
        x, y, used = (
            torch.tensor(each, dtype=torch.float64, device=device)
            for each in (self.x[own], self.target[own], np.take_along_axis(rows, own, axis=1))
        )
        many, tags = len(rows), [self.seed, units, *rows.sum(axis=1).tolist()]
        number = int(np.random.SeedSequence(tags).generate_state(1, np.uint64)[0])
        shape = NetworkShape(x.shape[2], units, y.shape[2])
        # These products are small: threads would wait for each other, for long on a busy computer
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            if self.network:
                stack = self.network.stack(shape.inputs, shape.outputs, device)
                start = self.network.starts(shape.inputs, shape.outputs, many, number).to(x)
            else:
                stack = TanhStack(shape, device)
                rng = torch.Generator(device).manual_seed(number)
                if self.init == "xavier":
                    start = stack.xavier_starts(many, rng)
                else:
                    fitness = stack.squared_error(x, y, used)
                    start = stack.sparrow_starts(fitness, many, rng, SparrowSearch(*self.search))
            found = back_propagate(stack, start, x, y, used)
        finally:
            torch.set_num_threads(threads)
        # equal optima: hidden units permuted, signs flipped
        evidence = found.evidence + math.lgamma(units + 1) + units * math.log(2.0)
        parts = (found.weights, found.beta**-0.5, evidence, found.root)
        return [_Fit(units, *each) for each in zip(*(p.cpu().numpy() for p in parts), strict=True)]

    def find_likeliest(
        self, sizes: Sequence[int], starts: int, tell: Callable[[int], None]
    ) -> list[_Fit]:
        """Train `starts` networks of each rising size until the evidence falls; likeliest first.

        A size with more than 1.5 weights per row is not tried, unless it is the first.
        """
        fits = list[_Fit]()
        for units in sizes:
            if fits and NetworkShape(self.x.shape[1], units, 3).size > 1.5 * len(self.x):
                break
            networks = self.train_batch(units, np.ones((starts, len(self.x)), bool))
            fits += networks
            tell(len(fits))
            if max(f.evidence for f in networks) < max(f.evidence for f in fits) - _UNLIKELY:
                break
        return sorted(fits, key=lambda each: -each.evidence)


def _draw_folds(q: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return masks (F, N) of the rows that each fold leaves out, repeats of a pose together."""
    _, pose = np.unique(np.round(q, 6), axis=0, return_inverse=True)
    pose = pose.ravel()
    fold = (rng.permutation(pose.max() + 1) % _FOLDS)[pose]
    return np.array([fold == k for k in range(_FOLDS) if (fold == k).any()])


def _calibrate(draft: Predictor, y: Array, left: Array, x: Array, probe: Array) -> Predictor:
    """Return a predictor with its gain, conformal factors and variance limit.

    Args:
        y: (N, 3) residual of the rows, m.
        left: (N, 3) the part of it that networks trained without each row leave, m.
        x: (N, d) inputs of the rows, standardised.
        probe: (M, d) inputs all over the training region, which set the variance limit.
    """
    _, epistemic = draft.mean_and_variance(x)
    score = np.abs(left) / np.sqrt(epistemic + draft.noise**2)
    level = min(1.0, np.ceil(LEVEL * (len(score) + 1)) / len(score))
    normal = NormalDist().inv_cdf(0.5 * (1.0 + LEVEL))  # of either sign
    _, variance = draft.mean_and_variance(probe)
    return replace(
        draft,
        widen=np.quantile(score, level, axis=0) / normal,
        alone=np.quantile(np.abs(y), level, axis=0) / normal,
        variance_limit=4.0 * float(np.quantile(variance.max(axis=1), 0.99)),
        gain=LearnedGain.of(y, left),
    )


def _find_leading_directions(draft: Predictor, root: Array, probe: Array) -> NDArray[np.float32]:
    """Return the leading directions (r, D) of the posterior of the weights.

    They hold 99.5 % of the Laplace variance of the outputs over the training region.
    """
    jacobian = draft.members.jacobian(probe[:500])
    spread = jacobian.reshape(-1, jacobian.shape[-1]) @ root.T
    values, vectors = np.linalg.eigh(spread.T @ spread)
    carried = np.cumsum(values[::-1]) / values.sum()
    count = int(np.searchsorted(carried, 0.995)) + 1
    return np.ascontiguousarray(vectors[:, ::-1][:, :count].T @ root, dtype=np.float32)
