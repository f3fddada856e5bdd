"""One posterior over explanations: a sum of single effects (SuSiE).

Wang, Sarkar, Carbonetto, Stephens (2020), "A simple new approach to variable selection in
regression", J. R. Statist. Soc. B 82.  The whitened data are

    y = A u + sum over l of X_c(l) b_l + e,    u, b, e unit normal

with the geometry A marginalised.  Each single effect l is one `Offer` c of a bank, or none.  Its
distribution q_l over the offers is computed from the residual that the other effects leave on
average. This is done for one effect after the other until none changes.  Offers that explain the
data equally well share the probability of q_l: they are the credible set.
"""

import math
from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from longarm_comp.core.calibration.linear import choose_sizes, log_mass, log_prior_mass, prior_root
from longarm_comp.core.identify.model_tolerance import FORM_KNOWN_WITHIN
from longarm_comp.core.identify.posterior.found import NONE, UNNAMED
from longarm_comp.core.identify.posterior.offer import Offer, OtherEffects, SingleEffect
from longarm_comp.core.identify.posterior.offer_table import Coefficients, OfferTable


class _Reduced(NamedTuple):
    """The offers that lose places to other effects."""

    numbers: np.ndarray
    left: dict[int, Offer]  # what is left of them, by number, if at least two places are
    table: OfferTable  # of `left`


class OfferBank:
    """A bank of offers over common columns, with the geometry marginalised.

    Args:
        offers: the C offers.
        gram: (K, K) products of the columns, projected off the geometry.
        along: (K,) products of the projected columns with the data.
        coefficients: the coefficients of the columns.
        sites: number of places at which a cause without a name may act.
        names: number of names that an effect may have, on offer or not; None: those on offer.

    Attributes:
        same_name: prior log odds that the next effect has a name that is there already, against
            those of a new name. A fault of one joint is likely at others too, so both cases have
            half of the probability.
        same_site: prior log odds that a cause without a name has a further function at its site,
            against those of another cause. A cause such as a hose often needs several functions. So
            a further one does not pay again for an effect, a cause without a name and its site.
    """

    def __init__(
        self,
        offers: Sequence[Offer],
        gram: np.ndarray,
        along: np.ndarray,
        coefficients: Coefficients,
        sites: int = 1,
        names: int | None = None,
    ) -> None:
        self.offers = tuple(offers)
        self.gram, self.along, self.coefficients = gram, along, coefficients
        each = np.array([offer.name for offer in offers])
        self._of_name = {name: each == name for name in set(each.tolist())}
        self.same_name = math.log(max(0.5 * (names or len(self._of_name)), 1.0))
        self.same_site = NONE + math.log(0.5 / UNNAMED) + math.log(sites)
        sites_of = np.array([offer.site for offer in offers])
        self._at_site = {site: sites_of == site for site in set(sites_of.tolist())}
        # By the places that other effects take; most of these leave the same of the offers
        self._reduced: dict[frozenset[Hashable], _Reduced] = {}
        self._left: dict[tuple[int, frozenset[Hashable]], Offer | None] = {}
        self._table_of_left: dict[Hashable, OfferTable] = {}
        self._evidences: dict[tuple[Offer, ...], float] = {}

    @cached_property
    def _table(self) -> OfferTable:
        return OfferTable(self.gram, self.coefficients, dict(enumerate(self.offers)))

    def imitates_a_name(self, offer: Offer) -> bool:
        """Tell whether an offer is a function without a name that moves the rows as a named effect.

        Then it is only another description of that effect. Two columns count as the same within
        `FORM_KNOWN_WITHIN`.
        """
        if not offer.site or len(offer.column_numbers) > 1:
            return False
        (k,) = offer.column_numbers
        squares = np.diag(self.gram)
        product = squares[k] * squares[self._named_columns] * (1.0 - FORM_KNOWN_WITHIN**2)
        return bool((self.gram[k, self._named_columns] ** 2 > np.maximum(product, 0.0)).any())

    @cached_property
    def _named_columns(self) -> np.ndarray:
        """The numbers of the columns of named effects that have a single column."""
        named = (offer.column_numbers for offer in self.offers if not offer.site)
        return np.array([own[0] for own in named if len(own) == 1], dtype=int)

    def compute_single_effect(self, along: np.ndarray, others: OtherEffects) -> SingleEffect:
        """Compute the distribution of one effect from the residual of the others.

        The products of the columns with this residual are `along` (K,).
        """
        reduced = self._reduce_offers(others.held)
        scores, whole = self._table.score_offers(along)
        scores[reduced.numbers] = -np.inf
        if reduced.left:
            scores[reduced.table.numbers], rest = reduced.table.score_offers(along)
        scores[list(others.excluded)] = -np.inf
        for name in others.names:
            scores[self._of_name[name]] += self.same_name
        for site in others.sites:  # whose name is among the names
            scores[self._at_site[site]] += self.same_site - self.same_name
        top = max(float(scores.max(initial=-np.inf)), 0.0)
        weights = np.exp(scores - top)
        q = weights / (weights.sum() + math.exp(-top))
        untouched = q.copy()
        untouched[reduced.numbers] = 0.0
        mean = self._table.mean_coefficients(whole, untouched)
        if reduced.left:
            mean = mean + reduced.table.mean_coefficients(rest, q[reduced.table.numbers])
        return SingleEffect(self.offers, q, mean, reduced.left)

    @cached_property
    def _numbers_at(self) -> dict[Hashable, list[int]]:
        """Numbers of the offers at each place."""
        made: dict[Hashable, list[int]] = {}
        for n, offer in enumerate(self.offers):
            for key in offer.keys:
                made.setdefault(key, []).append(n)
        return made

    @cached_property
    def _several(self) -> dict[int, frozenset[Hashable]]:
        """The places of the offers of which a part may be left: those at more than two places."""
        return {n: frozenset(o.keys) for n, o in enumerate(self.offers) if len(o.keys) > 2}

    def _reduce_offers(self, held: frozenset[Hashable]) -> _Reduced:
        """Return what is left of the offers if other effects take the places `held`."""
        if held not in self._reduced:
            numbers = sorted({n for key in held for n in self._numbers_at.get(key, ())})
            taken = {n: held & self._several[n] for n in numbers if n in self._several}
            rest = {n: self._free_part(n, lost) for n, lost in taken.items()}
            left = {n: offer for n, offer in rest.items() if offer is not None}
            kept = tuple((n, taken[n]) for n in left)
            if kept not in self._table_of_left:
                self._table_of_left[kept] = OfferTable(self.gram, self.coefficients, left)
            self._reduced[held] = _Reduced(np.array(numbers, int), left, self._table_of_left[kept])
        return self._reduced[held]

    def _free_part(self, number: int, held: frozenset[Hashable]) -> Offer | None:
        key = number, held
        if key not in self._left:
            self._left[key] = self.offers[number].free_part(held)
        return self._left[key]

    @property
    def scores(self) -> np.ndarray:
        """(C,) log odds of every offer alone against none."""
        return self._table.score_offers(self.along)[0]

    def evidence(self, chosen: Sequence[Offer]) -> float:
        """Return the log evidence of offers together, each with its prior odds against none."""
        key = tuple(chosen)
        if key not in self._evidences:
            self._evidences[key] = float(self.evidence_of_sets([chosen])[0])
        return self._evidences[key]

    def evidence_of_sets(self, sets: Sequence[Sequence[Offer]]) -> np.ndarray:
        """Return the `evidence` of each of many sets of offers, (number of sets,), much faster."""
        return self._solve_sets(sets)[0]

    def worth_their_price(self, chosen: Sequence[Offer]) -> list[int]:
        """Return the positions in `chosen` of the offers that raise the evidence, priors included.

        The offer that contributes least is dropped, again and again, until the evidence would fall.
        """
        kept, best = list(range(len(chosen))), self.evidence(chosen)
        while kept:
            fewer = [[n for n in kept if n != gone] for gone in kept]
            worth = self.evidence_of_sets([[chosen[n] for n in some] for some in fewer])
            if worth.max() < best:
                break
            kept, best = fewer[int(np.argmax(worth))], float(worth.max())
        return kept

    def solve_together(self, chosen: Sequence[Offer]) -> tuple[float, list[np.ndarray]]:
        """Return `evidence`, and the coefficients of each offer at the posterior mode."""
        total, (mean,) = self._solve_sets([chosen])
        made, start = [], 0
        for offer in chosen:
            count = len(offer.column_numbers)
            made.append(np.ones(count) if offer.fixed else mean[start : start + count])
            start += 0 if offer.fixed else count
        return float(total[0]), made

    def _solve_sets(self, sets: Sequence[Sequence[Offer]]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the log evidence of each set of offers, and the coefficients of each set.

        The coefficients are at the posterior mode, offer by offer, without those of fixed offers.
        """
        totals, means = np.zeros(len(sets)), [np.zeros(0) for _ in sets]
        alike: dict[tuple[int, int], list[int]] = {}
        free = [[offer for offer in chosen if not offer.fixed] for chosen in sets]
        along = self.along[None].repeat(len(sets), axis=0)
        for n, chosen in enumerate(sets):
            sites = [offer.site for offer in chosen if offer.site]
            together = len(sites) - len(set(sites))
            again = len(chosen) - len({offer.name for offer in chosen}) - together
            totals[n] = sum(offer.log_prior - NONE for offer in chosen)
            totals[n] += self.same_name * again + self.same_site * together
            whole = [k for offer in chosen if offer.fixed for k in offer.column_numbers]
            if whole:
                shared = self.gram[whole].sum(0)
                totals[n] += along[n, whole].sum() - 0.5 * shared[whole].sum()
                along[n] -= shared
            if free[n]:
                size = sum(len(offer.column_numbers) for offer in free[n]), len(free[n][0].sizes)
                alike.setdefault(size, []).append(n)
        for ns in alike.values():
            places = np.array([[k for o in free[n] for k in o.column_numbers] for n in ns])
            sizes = np.array([[o.sizes for o in free[n] for _ in o.column_numbers] for n in ns])
            chances = np.array([[o.chances for o in free[n] for _ in o.column_numbers] for n in ns])
            s = self.gram[places[:, :, None], places[:, None, :]]
            t = np.take_along_axis(along[ns], places, axis=1)
            lower, upper, like = (each[places] for each in self.coefficients)
            root = prior_root(like)
            # Sizes are chosen from the coefficients by the smallest and by the largest size, and
            # the better choice is kept: with the largest, two coefficients that the data hardly
            # tell apart may grow against each other.
            begun = np.stack([sizes.min(-1), sizes.max(-1)])
            first = _find_mode(s, t, begun[..., None] * root)
            scale, chance = choose_sizes(first, sizes[None], chances[None], like)
            mean, sd, factor = _solve_coefficients(s, t, scale[..., None] * root)
            inside = log_mass((lower - mean) / sd, (upper - mean) / sd).sum(-1)
            inside = inside - log_prior_mass(lower / scale, upper / scale, like)
            (small, large), (by_small, by_large) = factor + chance + inside, mean
            totals[ns] += np.where(small >= large, small, large)
            mode = np.where((small >= large)[:, None], by_small, by_large)
            for n, mean in zip(ns, np.clip(mode, lower, upper), strict=True):
                means[n] = mean
        return totals, means


def _find_mode(s: np.ndarray, t: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the posterior mean (..., K) of coefficients ``root w``, w unit normal.

    The products of the columns with each other are s (..., K, K), with the data t (..., K).
    """
    turned = np.swapaxes(root, -1, -2)
    precision = np.eye(t.shape[-1]) + turned @ s @ root
    return np.asarray((root @ np.linalg.solve(precision, turned @ t[..., None]))[..., 0])


def _solve_coefficients(
    s: np.ndarray, t: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean (..., K), standard deviation (..., K) and log evidence (...), as `_find_mode`."""
    turned = np.swapaxes(root, -1, -2)
    precision = np.eye(t.shape[-1]) + turned @ s @ root
    inverse = root @ np.linalg.inv(precision) @ turned
    mean = (inverse @ t[..., None])[..., 0]
    evidence = ((t * mean).sum(-1) - np.linalg.slogdet(precision)[1]) / 2
    return mean, np.sqrt(np.diagonal(inverse, axis1=-2, axis2=-1)), evidence
