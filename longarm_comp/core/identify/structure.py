"""Is there anything left?  A score test per group of inputs, calibrated by permutation.

It knows no physics: whatever moves the tip, or a joint, as some function of a joint, of a pair
of joints, of the approach, temperature, time or payload shows here (`features`), whether the
library has a name for it or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.features import groups
from longarm_comp.core.identify.fit import Fit
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.weights import whiten

PERMUTATIONS = 400
SIGNIFICANT = 0.005
MOST_GROUPS = 40
"""Groups that count as the structure, at most; those above a third of the strongest are named."""
WORTH = 0.25
"""Structure below this share of the noise is not worth a verdict."""


@dataclass(frozen=True)
class Structure:
    """What is left in the residual.

    Attributes:
        flag: whether it is more than noise.
        p_value: of the largest group statistic.
        inputs: the inputs it depends on, strongest first.
        size_m: RMS of the smooth part, m.
        share_explained: of the structure that was there, how much the named effects took
            (1 when nothing else is left).
        groups: (what, standardised statistic) of every group tested.
        at: the joint that the strongest of them moves; empty where it is the tip.
    """

    flag: bool
    p_value: float
    inputs: tuple[str, ...]
    size_m: float
    share_explained: float
    groups: tuple[tuple[str, float], ...]
    at: str = ""


def examine(fit: Fit, base: Fit, rng: np.random.Generator) -> Structure:
    """Test what a fit leaves.

    Args:
        fit: with everything that was named.
        base: the geometry alone, on the same rows and with the same noise.
        rng: for the permutations.
    """
    tested = groups(fit)
    marginal = Marginal(fit.design, fit.data)
    residual = fit.whitened(fit.residual[..., None])[:, 0]
    rows = residual.reshape(-1, 3)
    draws = np.stack(
        [rows[rng.permutation(len(rows))].reshape(-1) for _ in range(PERMUTATIONS)], axis=1
    )
    null = marginal.project(draws)
    real = marginal.py
    statistics, nulls, smooth = [], [], []
    for group in tested:
        b = fit.whitened(group.columns)
        pb = marginal.project(b)
        gram = b.T @ pb
        values, vectors = np.linalg.eigh((gram + gram.T) / 2)
        good = values > 1e-6 * len(rows)
        if not good.any():
            continue
        root = vectors[:, good] / np.sqrt(values[good])
        directions = pb @ root if fit.rho else b @ root
        real_score = ((directions.T @ real) ** 2).sum()
        null_score = ((directions.T @ null) ** 2).sum(0)
        centre, spread = null_score.mean(), max(float(null_score.std()), 1e-9)
        statistics.append((group, (real_score - centre) / spread))
        nulls.append((null_score - centre) / spread)
        smooth.append(b)
    if not statistics:
        return Structure(False, 1.0, (), 0.0, 1.0, ())
    highest = np.max(nulls, axis=0)
    top = max(s for _, s in statistics)
    p = float((1 + (highest >= top).sum()) / (1 + len(highest)))
    limit = float(np.quantile(highest, 0.99))
    order = sorted(range(len(statistics)), key=lambda k: -statistics[k][1])
    strong = [k for k in order if statistics[k][1] > limit][:MOST_GROUPS]
    size, rss_rich = _smooth(fit, marginal, [smooth[k] for k in strong])
    said = [statistics[k][0] for k in strong if statistics[k][1] > top / 3]
    inputs = tuple(dict.fromkeys(name for group in said for name in group.inputs))
    flag = p < SIGNIFICANT and size > WORTH * float(np.linalg.norm(fit.sigma))
    rss_named = float(residual @ residual)
    white_base = whiten(base.residual[..., None], fit.weights, fit.sigma, fit.rho)[:, 0]
    rss_base = float(white_base @ white_base)
    there = rss_base - rss_rich
    share = 1.0 if there <= 0 else float(np.clip((rss_base - rss_named) / there, 0.0, 1.0))
    return Structure(
        flag,
        p,
        inputs if flag else (),
        size if flag else 0.0,
        share if flag else 1.0,
        tuple((g.label, float(s)) for g, s in statistics),
        statistics[order[0]][0].at if flag else "",
    )


def _smooth(fit: Fit, marginal: Marginal, bases: list[np.ndarray]) -> tuple[float, float]:
    """RMS (m, 3-D) of the smooth part in the given features, and the whitened RSS they leave."""
    residual = fit.whitened(fit.residual[..., None])[:, 0]
    if not bases:
        return 0.0, float(residual @ residual)
    b = np.concatenate(bases, axis=1)
    added = marginal.added(b)
    part = marginal.project(b) @ added.mean
    rows = (part.reshape(-1, 3) * fit.sigma) ** 2
    left = residual - part
    return float(np.sqrt(rows.sum(1).mean())), float(left @ left)
