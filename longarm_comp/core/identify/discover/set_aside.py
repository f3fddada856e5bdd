"""Rows that were set aside as outliers, looked at as a group: do they share one displacement?

A bracket that flips in few rows looks like outliers.  Outliers do not agree with each other.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from longarm_comp.core.effects.function import Function
from longarm_comp.core.effects.shapes import Switch
from longarm_comp.core.identify.discover.bank import Bank, Hypothesis, Spot
from longarm_comp.core.identify.discover.functions import SWITCH, FunctionGroup, switch
from longarm_comp.core.identify.discover.inputs import Arguments
from longarm_comp.core.identify.model_fit import ModelFit

LEAST = 4
"""Rows that make a group, at least."""
MOST = 200
"""Of them, whose displacement is tried for all, at most."""
SEPARATING = 8
"""Switches that are tried, those that tell the group from the rest best."""
LINE = 2.0
"""Noise across a line along which all outliers may lie, in units of the noise."""
SURE = 12.0
"""Log odds from which on it is believed: outliers follow no law exactly."""
TAILS = 2.0
"""Degrees of freedom of the law of outliers."""
_STEPS = 5


@dataclass(frozen=True)
class SharedDisplacement:
    """Rows of weight 0 that one displacement explains.

    Attributes:
        rows: (N,) which they are.
        length_m: their median error, m.
        log_evidence: for it, against as many outliers.
    """

    rows: np.ndarray
    length_m: float
    log_evidence: float

    @property
    def sentence(self) -> str:
        """How many rows, and by how much they are off."""
        count = f"{self.rows.sum()} of {len(self.rows)}"
        return f"{count} share one displacement ({1e3 * self.length_m:.2f} mm)"

    @property
    def log_choices(self) -> float:
        """Log of the number of ways to choose as many outliers of all rows."""
        n, k = len(self.rows), int(self.rows.sum())
        return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


def shared(
    fit: ModelFit, sides: Iterable[tuple[Sequence[Spot], np.ndarray]]
) -> SharedDisplacement | None:
    """The most probable displacement that rows set aside share, of the arm's or the camera's side.

    Args:
        fit: whose rows of weight 0 are looked at.
        sides: K components, and (N, d, K) motion of the channels by a unit of each, m or rad.
    """
    if (fit.weights == 0).sum() < LEAST:
        return None
    found = [_of_one_side(fit, spots, units) for spots, units in sides]
    return max((s for s in found if s is not None), key=lambda s: s.log_evidence, default=None)


def _of_one_side(
    fit: ModelFit, spots: Sequence[Spot], units: np.ndarray
) -> SharedDisplacement | None:
    """The displacement that rows set aside share; None where they are outliers.

    Every row is either an outlier, of a law with a covariance of its own (cameras err along their
    sight), or displaced by the same amount of the same component, or by the same vector.
    """
    out = np.flatnonzero(fit.weights == 0)
    if not spots:
        return None
    held = np.isfinite(fit.sigma) & fit.session.measured[out]
    noise = np.where(np.isfinite(fit.sigma), fit.sigma, 1.0)
    columns = fit.columns[out]
    own = np.einsum("nip,pq,niq->ni", columns, fit.covariance, columns, optimize=True)
    over = held / np.sqrt(noise**2 + own)
    r, u = fit.residual[out] * over, units[out] * over[..., None]
    groups = _groups(spots)
    ks, amounts, gain = _commonest(r, u, _outliers(r), groups)
    inside = gain > 0
    if inside.sum() < LEAST:
        return None
    design = u[inside][:, :, ks] * amounts
    _, occam = np.linalg.slogdet(np.eye(len(ks)) + np.einsum("nda,ndb->ab", design, design))
    total = float(np.logaddexp(gain, 0.0).sum() - len(out) * math.log(2.0))
    evidence = total - math.log(len(groups)) - 0.5 * float(occam)
    if evidence < SURE:
        return None
    rows = np.zeros(len(fit.weights), bool)
    rows[out[inside]] = True
    length = float(np.median(np.linalg.norm(fit.residual[rows] * fit.metres, axis=1)))
    return SharedDisplacement(rows, length, evidence)


def _groups(spots: Sequence[Spot]) -> list[list[int]]:
    """Positions of components that are displaced together: each alone, and moves of a place."""
    moves: dict[tuple[str, str], list[int]] = {}
    for k, spot in enumerate(spots):
        if spot.kind[1] == "move":
            moves.setdefault(spot.kind, []).append(k)
    return [*([k] for k in range(len(spots))), *(ks for ks in moves.values() if len(ks) > 1)]


def _outliers(r: np.ndarray) -> np.ndarray:
    """(n,) log density of (n, d) whitened errors, the unit normal's constant left out.

    Student's law with few degrees of freedom: most outliers are just beyond what is believed, some
    are far off.
    """
    n, d = r.shape
    scale, share = r.T @ r / n, np.ones(n)
    for _ in range(4 * _STEPS):
        scale = ((r * share[:, None]).T @ r + d * LINE**2 * np.eye(d)) / n
        far = (r * np.linalg.solve(scale, r.T).T).sum(axis=1)
        share = (TAILS + d) / (TAILS + far)
    _, log_det = np.linalg.slogdet(scale)
    constant = math.lgamma((TAILS + d) / 2) - math.lgamma(TAILS / 2) + d / 2 * math.log(2 / TAILS)
    return np.asarray(constant - 0.5 * (log_det + (TAILS + d) * np.log1p(far / TAILS)))


def _commonest(
    r: np.ndarray, u: np.ndarray, apart: np.ndarray, groups: Sequence[Sequence[int]]
) -> tuple[Sequence[int], np.ndarray, np.ndarray]:
    """Components and amounts that most errors share, and (n,) log odds of each row for them."""
    tried = np.linspace(0, len(r) - 1, min(len(r), MOST)).round().astype(int)

    def odds(ks: Sequence[int], amounts: np.ndarray) -> np.ndarray:
        left = r - np.einsum("nda,ta->tnd", u[:, :, ks], amounts)
        return np.asarray(-0.5 * (left**2).sum(axis=2) - apart)

    best, at, amounts = -math.inf, groups[0], np.zeros(len(groups[0]))
    for ks in groups:
        each = np.einsum("tad,td->ta", np.linalg.pinv(u[tried][:, :, ks]), r[tried])
        totals = np.logaddexp(odds(ks, each), 0.0).sum(axis=1)
        i = int(np.argmax(totals))
        if totals[i] > best:
            best, at, amounts = float(totals[i]), ks, each[i]
    mine = u[:, :, at]
    for _ in range(_STEPS):
        share = expit(odds(at, amounts[None])[0])
        gram = np.einsum("n,nda,ndb->ab", share, mine, mine)
        right = np.einsum("n,nda,nd->a", share, mine, r)
        amounts = np.linalg.lstsq(gram, right, rcond=None)[0]
    return at, amounts, odds(at, amounts[None])[0]


def given_back(fit: ModelFit, rows: np.ndarray) -> ModelFit:
    """The fit with some rows of weight 0 counted again."""
    return dataclasses.replace(fit, weights=np.where(rows, 1.0, fit.weights))


def switches(bank: Bank, fit: ModelFit, rows: np.ndarray) -> list[Hypothesis]:
    """Candidates of a bank that tell some rows from all others that count.

    Args:
        rows: (N,) the group.
    """
    if SWITCH not in bank.priors:
        return []
    made = []
    for shape in _separating(bank.functions.inputs, rows, fit.weights > 0):
        function = Function((shape,))
        rare = sum(not q.plain for q in function.quantities)
        prior = bank.prior(FunctionGroup(SWITCH, (), (1.0,), rare))
        for ks in _groups(bank.places):
            members = tuple((bank.places[k], function) for k in ks)
            made.append(Hypothesis(members, (1.0,) * len(ks), SWITCH, prior))
    return made


def _separating(inputs: Arguments, rows: np.ndarray, counted: np.ndarray) -> list[Switch]:
    found: list[tuple[int, Switch]] = []
    for one in inputs.all:
        if one.smooth:
            continue
        order = np.argsort(one.values[counted | rows], kind="stable")
        values, mine = one.values[counted | rows][order], rows[counted | rows][order]
        wrong = np.cumsum(~mine) + mine.sum() - np.cumsum(mine)  # the group lies below
        wrong = np.minimum(wrong, len(mine) - wrong)[:-1]
        wrong[np.diff(values) <= 0] = len(mine)
        cut = int(np.argmin(wrong)) if len(wrong) else 0
        if len(wrong) and wrong[cut] < mine.sum() / 2:
            threshold = 0.5 * float(values[cut] + values[cut + 1])
            found.append((int(wrong[cut]), switch(one, threshold)))
    found.sort(key=lambda pair: pair[0])
    return [shape for _, shape in found[:SEPARATING]]
