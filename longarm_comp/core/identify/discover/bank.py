"""Every component times every function, scored at once on top of a fit.

A candidate's column is the motion of the channels by a unit of a component, row by row times a
function of the inputs.  Its products with the geometry's columns and with the residual are
therefore matrix products, and the evidence of some hundred thousand candidates takes a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from longarm_comp.core.effects.function import Function
from longarm_comp.core.identify.discover.functions import (
    EACH_JOINT,
    FunctionFamily,
    FunctionGroup,
    Functions,
)
from longarm_comp.core.identify.discover.score import many, rank_one
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.model_fit import ModelFit, priors

MOST_ROWS = 350
"""Rows that candidates are screened on; the best are scored on all."""
FULL = 500
"""Groups of several columns that are screened in full, the best by their single columns."""
RARE = 3.0
"""Log odds against a quantity that a cause is not likely to depend on."""
_WEAK = 1e-4
"""Share of a column that must be left beside the geometry."""


@dataclass(frozen=True)
class Spot:
    """Where, and which component: of the arm a place and a twist or load, of the camera an axis."""

    at: str
    component: str

    @property
    def kind(self) -> tuple[str, str]:
        """Spot and word of the component, without its axis."""
        return self.at, self.component.split(" ")[0]


@dataclass(frozen=True)
class Hypothesis:
    """Columns that are fitted together.

    Attributes:
        members: place and function of each column.
        decay: prior of each, against the first.
        family: kind of function.
        log_prior: of the choice among all candidates.
    """

    members: tuple[tuple[Spot, Function], ...]
    decay: tuple[float, ...]
    family: FunctionFamily
    log_prior: float

    @property
    def functions(self) -> tuple[Function, ...]:
        """The functions, each once."""
        return tuple(dict.fromkeys(f for _, f in self.members))


@dataclass(frozen=True)
class Weighed:
    """A candidate and its evidence.

    Attributes:
        candidate: the columns.
        log_evidence: log Bayes factor averaged over amplitudes, with the prior of the choice.
        mean: (r,) amounts, SI; scale: (r,) their prior standard deviations at the best amplitude.
    """

    candidate: Hypothesis
    log_evidence: float
    mean: np.ndarray
    scale: np.ndarray


class Bank:
    """All candidates of one side: components times functions.

    Args:
        places: K components.
        units: (N, d, K) motion of the channels by a unit of each, m or rad.
        functions: G functions at the N rows.
        axes: by commanded joint (0-based), the place that moves it along its own axis.
    """

    def __init__(
        self,
        places: Sequence[Spot],
        units: np.ndarray,
        functions: Functions,
        axes: Sequence[Spot] = (),
    ) -> None:
        self.places, self.units, self.functions = tuple(places), units, functions
        self._number = {place: k for k, place in enumerate(self.places)}
        kinds: dict[tuple[str, str], list[int]] = {}
        for k, place in enumerate(self.places):
            kinds.setdefault(place.kind, []).append(k)
        self.vectors = [ks for ks in kinds.values() if len(ks) == 3]
        self.axes = [self._number[place] for place in axes]
        self.priors = self._priors()

    def _priors(self) -> dict[FunctionFamily, float]:
        """Log prior of a candidate of each kind of function; half for single components."""
        counts: dict[FunctionFamily, int] = {}
        for group in self.functions.groups:
            counts[group.family] = counts.get(group.family, 0) + 1
        return {f: math.log(f.share / (2.0 * n * len(self.places))) for f, n in counts.items()}

    def prior(self, group: FunctionGroup) -> float:
        """Log prior of a group of functions at one component."""
        return self.priors[group.family] - RARE * group.rare

    def columns(self, members: Sequence[tuple[Spot, Function]]) -> np.ndarray:
        """(N, d, r) columns per unit."""
        made = [
            self.units[:, :, self._number[p]] * self.functions.of(f)[:, None] for p, f in members
        ]
        return np.stack(made, axis=-1)

    def screened(
        self, fit: ModelFit, design: np.ndarray, py: np.ndarray, best: int
    ) -> list[Hypothesis]:
        """The best candidates of every kind, on some of the rows.

        Args:
            fit: whose rows and noise count.
            design: (N, d, p) whitened and prior-scaled columns of what is in the model.
            py: (N, d) the residual, whitened and projected off these.
            best: how many, of single columns and of groups.
        """
        rows = _some(np.flatnonzero(fit.weights > 0))
        white = (self.units * weight(fit)[..., None])[rows].astype(np.float32)
        values = self.functions.values[rows]
        size = np.sqrt((values**2).mean(axis=0))
        values = (values / np.where(size > 0, size, 1.0)).astype(np.float32)
        flat = design[rows].reshape(-1, design.shape[-1])
        factor = cholesky(flat.T @ flat + np.eye(flat.shape[1]), lower=True)
        turned = np.einsum("ncp,nck->kpn", design[rows], white, optimize=True)
        turned = solve_triangular(
            factor, np.moveaxis(turned, 1, 0).reshape(len(factor), -1), lower=True
        ).astype(np.float32)
        turned = np.moveaxis(turned.reshape(len(factor), len(self.places), len(rows)), 1, 0)
        return list(_Screen(self, white, values, py[rows].astype(np.float32), turned).best(best))

    def score(self, marginal: Marginal, fit: ModelFit, candidate: Hypothesis) -> Weighed:
        """Exact evidence of a candidate on top of a marginal, on all rows."""
        columns = self.columns(candidate.members)
        flat = (columns * weight(fit)[..., None])[fit.weights > 0].reshape(-1, columns.shape[-1])
        return scored(marginal, flat, candidate)


def scored(marginal: Marginal, flat: np.ndarray, candidate: Hypothesis) -> Weighed:
    """Evidence of whitened columns (m, r), and their amounts."""
    rows = len(flat) / 3.0
    size = np.sqrt(np.maximum((flat**2).sum(0) / rows, 1e-300))
    unit = flat * (np.array(candidate.decay) / size)
    projected = marginal.project(unit)
    t, s = unit.T @ marginal.py, unit.T @ projected
    evidence, amplitude = many(t[None], s[None])
    a = float(amplitude[0])
    mean = a * np.linalg.solve(np.eye(len(t)) + a * a * (s + s.T) / 2, a * t)
    per = np.array(candidate.decay) / size
    return Weighed(candidate, float(evidence[0]) + candidate.log_prior, mean * per, a * per)


def weight(fit: ModelFit) -> np.ndarray:
    """(N, d) one over the noise where a row counts and holds a channel, else 0."""
    held = np.isfinite(fit.sigma) & fit.session.measured
    return np.where(held, np.sqrt(fit.weights)[:, None] / fit.sigma, 0.0)


def whitened_design(fit: ModelFit) -> np.ndarray:
    """(N, d, p) columns of a fit, prior-scaled and over the noise."""
    return fit.columns * priors(fit.slots) * weight(fit)[..., None]


def _some(rows: np.ndarray) -> np.ndarray:
    """At most `MOST_ROWS` of the rows, evenly spread."""
    if len(rows) <= MOST_ROWS:
        return rows
    return rows[np.linspace(0, len(rows) - 1, MOST_ROWS).round().astype(int)]


class _Screen:
    """One pass over all candidates of a bank."""

    def __init__(
        self, bank: Bank, white: np.ndarray, values: np.ndarray, py: np.ndarray, turned: np.ndarray
    ) -> None:
        self.bank, self.white, self.values, self.turned = bank, white, values, turned
        square = np.einsum("nck,nck->kn", white, white)
        raw = square @ values**2
        self.t = np.einsum("nc,nck->kn", py, white) @ values
        s = raw - np.stack([((h @ values) ** 2).sum(0) for h in turned])
        self.size2 = np.maximum(raw / len(values), 1e-30)
        usable = (raw > 1e-25) & (s > _WEAK * raw)
        self.s = np.maximum(s, _WEAK * raw)
        self.usable = usable
        self.alone = np.where(usable, self.t**2 / np.maximum(self.s, 1e-30), 0.0)

    def best(self, count: int) -> Iterator[Hypothesis]:
        """The best of every kind."""
        yield from self._singles(count)
        yield from self._groups(count)
        yield from self._vectors(count)

    def _singles(self, count: int) -> Iterator[Hypothesis]:
        groups = [g for g in self.bank.functions.groups if len(g.functions) == 1]
        chosen = np.array([g.functions[0] for g in groups], dtype=int)
        prior = np.array([self.bank.prior(g) for g in groups])
        evidence = rank_one(self.t[:, chosen], self.s[:, chosen], self.size2[:, chosen])
        table = np.where(self.usable[:, chosen], evidence + prior, -np.inf)
        sharp = np.array([g.family.sharp for g in groups])
        for wanted in (sharp, ~sharp):
            for k, j in _top(np.where(wanted, table, -np.inf), count):
                member = (self.bank.places[k], self.bank.functions.listed[chosen[j]])
                yield Hypothesis((member,), (1.0,), groups[j].family, float(prior[j]))

    def _groups(self, count: int) -> Iterator[Hypothesis]:
        """Groups of functions at one component."""
        ranked = []
        for g in self.bank.functions.groups:
            if len(g.functions) > 1:
                alone = self.alone[:, list(g.functions)]
                ranked += [(float(a), k, g) for k, a in enumerate(alone.sum(1)) if a > 0]
        ranked.sort(key=lambda r: -r[0])
        made = []
        for _, k, g in ranked[:FULL]:
            members = tuple((k, f) for f in g.functions)
            made.append((members, g.decay, g.family, self.bank.prior(g)))
        yield from self._full(made, count)

    def _vectors(self, count: int) -> Iterator[Hypothesis]:
        """One function along x, y and z together; and each joint by its own."""
        singles = {g.functions[0]: g for g in self.bank.functions.groups if len(g.functions) == 1}
        made = []
        totals = np.stack([self.alone[ks].sum(0) for ks in self.bank.vectors]) if (
            self.bank.vectors
        ) else np.zeros((0, self.alone.shape[1]))  # fmt: skip
        for v, f in _top(totals, FULL):
            if f in singles:
                g, ks = singles[f], self.bank.vectors[v]
                members = tuple((k, f) for k in ks)
                prior = self.bank.prior(g)
                made.append((members, (1.0,) * 3, g.family, prior))
        yield from self._full(made, count)
        every = self.bank.functions.each_joint if self.bank.axes else []
        prior = math.log(EACH_JOINT.share / max(len(every), 1))
        joints = []
        for members in every:
            at = tuple((self.bank.axes[j], f) for j, f in members)
            seen = tuple((k, f) for k, f in at if self.usable[k, f])
            if len(seen) > 1:
                joints.append((seen, (1.0,) * len(seen), EACH_JOINT, prior))
        yield from self._full(joints, count)

    def _full(self, groups: list, count: int) -> Iterator[Hypothesis]:
        found: list[tuple[float, Hypothesis]] = []
        for rank in {len(g[0]) for g in groups}:
            mine = [g for g in groups if len(g[0]) == rank]
            t = np.zeros((len(mine), rank))
            s = np.zeros((len(mine), rank, rank))
            for m, (members, decay, _, _) in enumerate(mine):
                unit = np.array(decay) / np.sqrt([self.size2[k, f] for k, f in members])
                t[m] = [self.t[k, f] for k, f in members] * unit
                s[m] = self._products(members) * np.outer(unit, unit)
            evidence, _ = many(t, s)
            for e, (members, decay, family, prior) in zip(evidence, mine, strict=True):
                named = tuple(
                    (self.bank.places[k], self.bank.functions.listed[f]) for k, f in members
                )
                found.append((float(e) + prior, Hypothesis(named, decay, family, prior)))
        found.sort(key=lambda pair: -pair[0])
        yield from (candidate for _, candidate in found[:count])

    def _products(self, members: Sequence[tuple[int, int]]) -> np.ndarray:
        """(r, r) products of some columns, projected."""
        columns = np.stack(
            [(self.white[:, :, k] * self.values[:, f, None]).ravel() for k, f in members]
        )
        turned = np.stack([self.turned[k] @ self.values[:, f] for k, f in members])
        return columns @ columns.T - turned @ turned.T


def _top(table: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Places of the largest finite entries, best first."""
    flat = table.ravel()
    if not flat.size:
        return []
    few = np.argpartition(-flat, min(count, flat.size - 1))[:count]
    few = few[np.argsort(-flat[few], kind="stable")]
    return [divmod(int(i), table.shape[1]) for i in few if np.isfinite(flat[i]) and flat[i] != 0]
