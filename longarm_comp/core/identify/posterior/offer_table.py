"""A table of offers, which are all scored at once on the residual of the other effects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from longarm_comp.core.calibration.linear import log_mass, log_prior_mass, prior_root
from longarm_comp.core.identify.posterior.found import NONE
from longarm_comp.core.identify.posterior.offer import Offer


class Products(NamedTuple):
    """Products of K columns with the geometry projected out, and limits of their coefficients.

    Attributes:
        gram: (K, K) products of the columns with each other.
        lower, upper: (K,) bounds of the coefficients, in units of the columns.
        like: (K,) group numbers; the coefficients of one group are correlated beforehand.
    """

    gram: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    like: np.ndarray


class OfferTable:
    """A table of R offers with at most P coefficients each, which are tried with A sizes.

    The coefficients of an offer are rotated so that its Gram matrix is diagonal and they are
    independent.  Missing coefficients are padded with size 0, missing sizes with probability 0.
    Coefficients of a fixed offer are 1.

    Attributes:
        numbers: the offers' numbers in their bank.
    """

    def __init__(self, of: Products, numbered: Mapping[int, Offer]) -> None:
        self.numbers, offers = list(numbered), list(numbered.values())
        r, k = len(offers), len(of.gram)
        counts = np.array([len(offer.column_numbers) for offer in offers])
        self._of, most = of, max(len(offer.sizes) for offer in offers)
        shape = r, counts.max(initial=0)
        self._column_numbers = np.full(shape, k)
        self._fixed = np.zeros(shape)
        self._turn = np.zeros((*shape, shape[1]))
        self._share = np.zeros((*shape, most))
        self._odds = np.full((r, most), -np.inf)
        self._price = np.array([offer.log_prior for offer in offers]) - NONE
        sizes = np.ones((r, most))
        for n, offer in enumerate(offers):
            self._column_numbers[n, : counts[n]] = offer.column_numbers
            sizes[n, : len(offer.sizes)] = offer.sizes
            self._odds[n, : len(offer.sizes)] = offer.chances
            if offer.fixed:
                own = list(offer.column_numbers)
                self._fixed[n, : counts[n]] = 1.0
                self._price[n] -= 0.5 * of.gram[np.ix_(own, own)].sum()
        free = np.array([not offer.fixed for offer in offers])
        for count in np.unique(counts[free]):
            self._rotate_group(np.flatnonzero(free & (counts == count)), count, sizes)
        bounds = (np.append(b, 0.0)[self._column_numbers] for b in (of.lower, of.upper))
        held = (np.arange(shape[1]) < counts[:, None]) & free[:, None]
        self._lower, self._upper = (
            np.where(held, b, e) for b, e in zip(bounds, (-np.inf, np.inf), strict=True)
        )
        row, at = np.nonzero(np.isfinite(self._lower) | np.isfinite(self._upper))
        self._bounded, self._starts = np.unique(row, return_index=True)
        self._row, self._turn_bounded = row, self._turn[row, at]  # (B, P)
        self._sd = np.sqrt(_multiply_rows(self._turn_bounded**2, self._share[row]))
        self._ends = self._lower[row, at][:, None], self._upper[row, at][:, None]

    @classmethod
    def of(cls, products: Products, numbered: Mapping[int, Offer]) -> list[OfferTable]:
        """Make a table of the offers with one coefficient, and one of those with several."""
        narrow = {n: o for n, o in numbered.items() if len(o.column_numbers) <= 1}
        wide = {n: o for n, o in numbered.items() if n not in narrow}
        return [cls(products, part) for part in (narrow, wide) if part]

    def _rotate_group(self, group: np.ndarray, count: int, sizes: np.ndarray) -> None:
        """Prepare the offers whose rows are listed in `group`, with `count` coefficients each."""
        of = self._of
        places = self._column_numbers[group, :count]
        s = of.gram[places[:, :, None], places[:, None, :]]
        root = prior_root(of.like[places])
        turned = np.swapaxes(root, -2, -1) @ (s + np.swapaxes(s, 1, 2)) @ root / 2
        values, turn = np.linalg.eigh(turned)
        self._turn[group, :count, :count] = root @ turn
        square = sizes[group][:, None, :] ** 2
        grown = 1.0 + square * np.maximum(values, 0.0)[..., None]
        self._share[group, :count] = square / grown
        self._odds[group] -= np.log(grown).sum(axis=1) / 2
        bounds = of.lower[places], of.upper[places]
        if np.isfinite(bounds).any():
            low, high = (b[:, None, :] / sizes[group][..., None] for b in bounds)
            self._odds[group] -= log_prior_mass(low, high, of.like[places][:, None, :])

    def score_offers(self, along: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Score every offer against no effect.

        Args:
            along: (K,) products of the columns with the residual of the other effects.

        Returns:
            (R,) log posterior odds, and the intermediate results that `mean_coefficients` needs.
        """
        own = np.append(along, 0.0)[self._column_numbers]
        z = _multiply_rows(own, self._turn)
        each = _multiply_rows(z**2, self._share) / 2 + self._odds
        if len(self._bounded):
            shrunk = (self._share * z[..., None]).take(self._row, axis=0)
            mean = _multiply_rows(self._turn_bounded, shrunk)
            low, high = ((end - mean) / self._sd for end in self._ends)
            each[self._bounded] += np.add.reduceat(log_mass(low, high), self._starts)
        top = each.max(axis=1)
        chance = np.exp(each - top[:, None])
        whole = chance.sum(axis=1)
        odds = top + np.log(whole) + self._price + (self._fixed * own).sum(axis=1)
        return odds, (z, chance / whole[:, None])

    def mean_coefficients(self, found: tuple[np.ndarray, np.ndarray], q: np.ndarray) -> np.ndarray:
        """Return the (K,) mean coefficients of the columns, averaged over offers and sizes.

        They are within their bounds.

        Args:
            found: the second result of `score_offers`.
            q: (R,) probability of each offer.
        """
        z, chance = found
        on = np.flatnonzero(q > np.finfo(float).eps)  # the others do not change the sum
        shrunk = (self._share[on] * chance[on][:, None, :]).sum(axis=-1) * z[on]
        mean = _multiply_rows(shrunk, np.swapaxes(self._turn[on], 1, 2))
        mean = np.clip(mean, self._lower[on], self._upper[on]) + self._fixed[on]
        made = np.zeros(len(self._of.gram) + 1)
        np.add.at(made, self._column_numbers[on].ravel(), (q[on][:, None] * mean).ravel())
        return made[:-1]


def _multiply_rows(rows: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Multiply each row of (R, P) by its own matrix of (R, P, Q); return (R, Q)."""
    if rows.shape[1] == 1:  # as most offers have one coefficient
        return np.asarray(rows * matrices[:, 0])
    return np.asarray(np.matmul(rows[:, None, :], matrices)[:, 0])
