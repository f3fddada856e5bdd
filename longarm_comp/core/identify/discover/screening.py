"""The best of all candidates of a bank, on some of the rows.

What depends on the fit alone is computed once.  A search asks many times with some of the model's
columns left out; the inverse of a block then corrects the products, whatever their number.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from longarm_comp.core.effects.function import Function
from longarm_comp.core.identify.discover.bank import (
    Bank,
    Hypothesis,
    Spot,
    flattened,
    weight,
    whitened_design,
)
from longarm_comp.core.identify.discover.functions import EACH_JOINT, FunctionFamily
from longarm_comp.core.identify.discover.score import many, rank_one
from longarm_comp.core.identify.model_fit import ModelFit

MOST_ROWS = 350
"""Rows that candidates are screened on; the best are scored on all."""
FULL = 500
"""Groups of several columns that are screened in full, the best by their single columns."""
_BLOCK = 64
"""Groups whose products are computed at once."""
_WEAK = 1e-4
"""Share of a column that must be left beside the geometry."""

_Group = tuple[tuple[tuple[int, int], ...], tuple[float, ...], FunctionFamily, float]
"""Place and function of each column, their decay, the kind of function, the log prior."""


class Screening:
    """Products of all candidates of a bank with a fit's columns.

    Args:
        bank: the candidates.
        fit: whose rows, noise and columns count.
    """

    def __init__(self, bank: Bank, fit: ModelFit) -> None:
        self.bank = bank
        self.rows = rows = _some(np.flatnonzero(fit.weights > 0))
        white = (bank.units * weight(fit)[..., None])[rows].astype(np.float32)
        values = bank.functions.values[rows]
        size = np.sqrt((values**2).mean(axis=0))
        self.values = (values / np.where(size > 0, size, 1.0)).astype(np.float32)
        self.white = np.ascontiguousarray(np.moveaxis(white, 2, 0))
        design = whitened_design(fit)[rows]
        flat = flattened(design)
        self._factor = cholesky(flat.T @ flat + np.eye(flat.shape[1]), lower=True)
        turned = np.einsum("ncp,knc->pkn", design, self.white, optimize=True)
        if turned.size:
            flat = turned.reshape(len(turned), -1)
            turned = solve_triangular(self._factor, flat, lower=True).reshape(turned.shape)
        self.turned = np.ascontiguousarray(np.moveaxis(turned, 1, 0), dtype=np.float32)
        self.raw = (self.white**2).sum(axis=2) @ self.values**2
        self.taken = self._squares(self.turned)
        self.size2 = np.maximum(self.raw / len(rows), 1e-30)
        self.singles = [g for g in bank.functions.groups if len(g.functions) == 1]
        self.chosen = np.array([g.functions[0] for g in self.singles], dtype=int)
        self.prior = np.array([bank.prior(g) for g in self.singles])
        self.sharp = np.array([g.family.sharp for g in self.singles], dtype=bool)
        self.several = [g for g in bank.functions.groups if len(g.functions) > 1]
        self.members = np.full(
            (len(self.several), max((len(g.functions) for g in self.several), default=0)), -1
        )
        for row, g in zip(self.members, self.several, strict=True):
            row[: len(g.functions)] = g.functions

    def best(self, kept: np.ndarray, py: np.ndarray, count: int) -> list[Hypothesis]:
        """The best candidates of every kind on top of some of the fit's columns.

        Args:
            kept: (p,) which columns of the fit are in the model.
            py: (N, d) the residual, whitened and projected off these.
            count: how many, of single columns and of groups.
        """
        return list(_Screen(self, kept, py[self.rows].astype(np.float32)).best(count))

    def freed(self, kept: np.ndarray) -> np.ndarray:
        """(K, g, n) what leaving g columns of the fit out gives back of each component."""
        gone = np.flatnonzero(~kept)
        identity = np.eye(len(self._factor))
        inverse = cho_solve((self._factor, True), identity)
        back = solve_triangular(self._factor.T, identity, lower=False)[gone]
        own = cholesky(inverse[np.ix_(gone, gone)], lower=True)
        turn = solve_triangular(own, back, lower=True).astype(np.float32)
        return np.asarray(np.einsum("gp,kpn->kgn", turn, self.turned, optimize=True))

    def _squares(self, turned: np.ndarray) -> np.ndarray:
        """(K, G) squares of the components times the functions."""

        def one(h: np.ndarray) -> np.ndarray:
            return np.asarray(((h @ self.values) ** 2).sum(axis=0))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return np.stack(list(pool.map(one, turned)))


def _some(rows: np.ndarray) -> np.ndarray:
    """At most `MOST_ROWS` of the rows, evenly spread."""
    if len(rows) <= MOST_ROWS:
        return rows
    return rows[np.linspace(0, len(rows) - 1, MOST_ROWS).round().astype(int)]


class _Screen:
    """One pass over all candidates."""

    def __init__(self, of: Screening, kept: np.ndarray, py: np.ndarray) -> None:
        self.of, self.bank = of, of.bank
        self.freed = None if kept.all() else of.freed(kept)
        s = of.raw - of.taken
        if self.freed is not None:
            s = s + of._squares(self.freed)
        self.t = np.einsum("nc,knc->kn", py, of.white) @ of.values
        self.usable = (of.raw > 1e-25) & (s > _WEAK * of.raw)
        self.s = np.maximum(s, _WEAK * of.raw)
        self.alone = np.where(self.usable, self.t**2 / np.maximum(self.s, 1e-30), 0.0)

    def best(self, count: int) -> Iterator[Hypothesis]:
        """The best of every kind."""
        yield from self._singles(count)
        yield from self._full(self._groups(), count)
        yield from self._full(self._vectors(), count)
        yield from self._full(self._joints(), count)

    def _singles(self, count: int) -> Iterator[Hypothesis]:
        of = self.of
        t, s, size2 = (part[:, of.chosen] for part in (self.t, self.s, of.size2))
        worth = np.where(self.usable[:, of.chosen], rank_one(t, s, size2) + of.prior, -np.inf)
        for wanted in (of.sharp, ~of.sharp):
            for k, j in _top(np.where(wanted, worth, -np.inf), count):
                group = of.singles[j]
                member = (self.bank.places[k], self.bank.functions.listed[of.chosen[j]])
                yield Hypothesis((member,), (1.0,), group.family, float(of.prior[j]))

    def _groups(self) -> Iterator[_Group]:
        """Groups of functions at one component."""
        padded = np.pad(self.alone, ((0, 0), (0, 1)))
        totals = np.zeros((len(padded), len(self.of.several)))
        for functions in self.of.members.T:
            totals += padded[:, functions]
        for k, g in _top(totals, FULL):
            group = self.of.several[g]
            members = tuple((k, f) for f in group.functions)
            yield members, group.decay, group.family, self.bank.prior(group)

    def _vectors(self) -> Iterator[_Group]:
        """One function along x, y and z together."""
        vectors = self.bank.vectors
        if not vectors:
            return
        singles = {g.functions[0]: g for g in self.of.singles}
        for v, f in _top(np.stack([self.alone[ks].sum(0) for ks in vectors]), FULL):
            if f in singles:
                g, members = singles[f], tuple((k, f) for k in vectors[v])
                yield members, (1.0,) * 3, g.family, self.bank.prior(g)

    def _joints(self) -> Iterator[_Group]:
        """Each joint by its own."""
        every = self.bank.functions.each_joint if self.bank.axes else []
        prior = math.log(EACH_JOINT.share / max(len(every), 1))
        for members in every:
            at = tuple((self.bank.axes[j], f) for j, f in members)
            seen = tuple((k, f) for k, f in at if self.usable[k, f])
            if len(seen) > 1:
                yield seen, (1.0,) * len(seen), EACH_JOINT, prior

    def _full(self, groups: Iterable[_Group], count: int) -> list[Hypothesis]:
        by_rank: dict[int, list[_Group]] = {}
        for group in groups:
            by_rank.setdefault(len(group[0]), []).append(group)
        found: list[tuple[float, Hypothesis]] = []
        for mine in by_rank.values():
            at = np.array([members for members, _, _, _ in mine])
            k, f = at[..., 0], at[..., 1]
            unit = np.array([decay for _, decay, _, _ in mine]) / np.sqrt(self.of.size2[k, f])
            s = self._products(k, f) * unit[:, :, None] * unit[:, None, :]
            evidence, _ = many(self.t[k, f] * unit, s)
            for e, (members, decay, family, prior) in zip(evidence, mine, strict=True):
                named = tuple(self._named(*member) for member in members)
                found.append((float(e) + prior, Hypothesis(named, decay, family, prior)))
        found.sort(key=lambda pair: -pair[0])
        return [candidate for _, candidate in found[:count]]

    def _named(self, k: int, f: int) -> tuple[Spot, Function]:
        return self.bank.places[k], self.bank.functions.listed[f]

    def _products(self, k: np.ndarray, f: np.ndarray) -> np.ndarray:
        """(M, r, r) products of the columns of M groups, projected; components and functions."""
        made = np.zeros((*k.shape, k.shape[1]))
        for start in range(0, len(k), _BLOCK):
            some = slice(start, start + _BLOCK)
            columns = self.of.white[k[some]] * self.of.values.T[f[some]][..., None]
            flat = columns.reshape(*k[some].shape, -1)
            made[some] = flat @ np.swapaxes(flat, 1, 2)
        made -= _outer(self._carried(self.of.turned, k, f))
        if self.freed is not None:
            made += _outer(self._carried(self.freed, k, f))
        return made

    def _carried(self, turned: np.ndarray, k: np.ndarray, f: np.ndarray) -> np.ndarray:
        """(M, r, p) of each column what `turned` takes up."""
        made = np.zeros((*k.shape, turned.shape[1]), dtype=np.float32)
        for place in np.unique(k):
            mine = k == place
            made[mine] = (turned[place] @ self.of.values[:, f[mine]]).T
        return made


def _outer(rows: np.ndarray) -> np.ndarray:
    return np.asarray(rows @ np.swapaxes(rows, 1, 2))


def _top(table: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Places of the largest finite entries, best first."""
    flat = table.ravel()
    if not flat.size:
        return []
    few = np.argpartition(-flat, min(count, flat.size - 1))[:count]
    few = few[np.argsort(-flat[few], kind="stable")]
    return [divmod(int(i), table.shape[1]) for i in few if np.isfinite(flat[i]) and flat[i] != 0]
