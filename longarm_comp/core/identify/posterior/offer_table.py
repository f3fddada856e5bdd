"""A table of offers, which are all scored at once on the residual of the other effects."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from longarm_comp.core.calibration.linear import log_mass, log_prior_mass, prior_root
from longarm_comp.core.identify.posterior.found import NONE
from longarm_comp.core.identify.posterior.offer import Offer


class Coefficients(NamedTuple):
    """The coefficients of K columns, as they are known beforehand.

    Attributes:
        lower, upper: (K,) their bounds, in units of the columns.
        like: (K,) group numbers; the coefficients of one group are correlated beforehand.
    """

    lower: np.ndarray
    upper: np.ndarray
    like: np.ndarray


class OfferTable:
    """A table of R offers with F coefficients in all, which are tried with A sizes.

    The coefficients of an offer are rotated so that its Gram matrix is diagonal and they are
    independent.  Missing sizes are padded with probability 0.  Coefficients of a fixed offer are 1.

    Attributes:
        numbers: (R,) the offers' numbers in their bank.
    """

    def __init__(self, gram: np.ndarray, of: Coefficients, numbered: Mapping[int, Offer]) -> None:
        """Make the table of offers, by number, from the projected products `gram` (K, K)."""
        self.numbers, offers = np.array(list(numbered), dtype=int), list(numbered.values())
        self._gram, self._of = gram, of
        most = max((len(offer.sizes) for offer in offers), default=1)
        counts = np.array([len(offer.column_numbers) for offer in offers], dtype=int)
        self._starts, r = np.cumsum(counts) - counts, len(offers)
        self._row = np.repeat(np.arange(r), counts)
        self._columns = np.array([k for o in offers for k in o.column_numbers], dtype=int)
        self._share = np.zeros((most, len(self._row)))
        self._odds = np.full((most, r), -np.inf)
        self._price = np.array([offer.log_prior for offer in offers]) - NONE
        sizes = np.ones((r, most))
        for n, offer in enumerate(offers):
            sizes[n, : len(offer.sizes)] = offer.sizes
            self._odds[: len(offer.sizes), n] = offer.chances
            if offer.fixed:
                own = list(offer.column_numbers)
                self._price[n] -= 0.5 * gram[np.ix_(own, own)].sum()
        fixed = np.array([offer.fixed for offer in offers], dtype=bool)
        self._fixed = fixed[self._row].astype(float)
        ends = np.cumsum(counts**2)
        turns = np.zeros(ends[-1] if r else 0)  # the rows of all rotations, offer by offer
        for count in np.unique(counts[~fixed]):
            group = np.flatnonzero(~fixed & (counts == count))
            own = self._starts[group][:, None] + np.arange(count)
            turn = self._rotate_group(group, own, sizes)
            turns[ends[group][:, None] - count**2 + np.arange(count**2)] = turn.reshape(
                len(group), -1
            )
        each = counts[self._row]
        first = np.append(0, np.cumsum(each))
        places = np.arange(len(turns)) + np.repeat(self._starts[self._row] - first[:-1], each)
        self._turn = csr_array((turns, places, first), shape=(len(each), len(each)))
        self._turn_back = self._turn.T.tocsr()
        free = self._fixed == 0.0
        self._lower, self._upper = (
            np.where(free, b[self._columns], e)
            for b, e in ((of.lower, -np.inf), (of.upper, np.inf))
        )
        at = np.flatnonzero(np.isfinite(self._lower) | np.isfinite(self._upper))
        self._bounded, self._first = np.unique(self._row[at], return_index=True)
        self._turn_bounded = self._turn[at]
        self._sd = np.sqrt(self._turn_bounded.power(2) @ self._share.T)
        self._ends = self._lower[at][:, None], self._upper[at][:, None]

    def _rotate_group(self, group: np.ndarray, own: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Prepare the offers whose rows are listed in `group` (g,).

        Args:
            own: (g, c) numbers of their coefficients.
            sizes: (R, A) sizes of all offers.

        Returns:
            The rotation (g, c, c) of each offer's coefficients.
        """
        of, places = self._of, self._columns[own]
        s = self._gram[places[:, :, None], places[:, None, :]]
        root = prior_root(of.like[places])
        turned = np.swapaxes(root, -2, -1) @ (s + np.swapaxes(s, 1, 2)) @ root / 2
        values, turn = np.linalg.eigh(turned)
        square = sizes[group].T[..., None] ** 2
        grown = 1.0 + square * np.maximum(values, 0.0)
        self._share[:, own] = square / grown
        self._odds[:, group] -= np.log(grown).sum(axis=2) / 2
        bounds = of.lower[places], of.upper[places]
        if np.isfinite(bounds).any():
            low, high = (b / sizes[group].T[..., None] for b in bounds)
            self._odds[:, group] -= log_prior_mass(low, high, of.like[places][None])
        return np.asarray(root @ turn)

    def score_offers(self, along: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Score every offer against no effect.

        Args:
            along: (K,) products of the columns with the residual of the other effects.

        Returns:
            (R,) log posterior odds, and the intermediate results that `mean_coefficients` needs.
        """
        own = along[self._columns]
        z = self._turn_back @ own
        shrunk = self._share * z
        each = np.add.reduceat(shrunk * z, self._starts, axis=1) / 2 + self._odds
        mean = self._turn_bounded @ shrunk.T
        low, high = ((end - mean) / self._sd for end in self._ends)
        each[:, self._bounded] += np.add.reduceat(log_mass(low, high), self._first).T
        top = each.max(axis=0)
        chance = np.exp(each - top)
        whole = chance.sum(axis=0)
        odds = top + np.log(whole) + self._price + np.add.reduceat(self._fixed * own, self._starts)
        return odds, (shrunk, chance / whole)

    def mean_coefficients(self, found: tuple[np.ndarray, np.ndarray], q: np.ndarray) -> np.ndarray:
        """Return the (K,) mean coefficients of the columns, averaged over offers and sizes.

        They are within their bounds.

        Args:
            found: the second result of `score_offers`.
            q: (R,) probability of each offer.
        """
        shrunk, chance = found
        mean = self._turn @ (shrunk * chance[:, self._row]).sum(axis=0)
        mean = np.minimum(np.maximum(mean, self._lower), self._upper) + self._fixed
        return np.bincount(self._columns, q[self._row] * mean, minlength=len(self._gram))
