"""The recursive posterior: a Kalman filter, and with it all changes that may have happened.

"Nothing changed" is one Kalman filter over the model's parameters, without process noise.  "Effect
c changed before sighting t" differs from it by a known linear response to the unknown jump. A
recursion updates this response (Willsky and Jones 1976, IEEE Trans. Automatic Control 21), so
hundreds of possible changes need one filter only.  Each change has its own evidence.  A drift
counts as a series of jumps.

The error that no parameter explains is nearly the same at each visit to a pose.  If it counted as
new noise at each visit, it would be learned as a fault of the arm. So the filter also estimates
m persistent errors: those that all sightings share, and that of each of the poses visited last.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from longarm_comp.core.at_work.changes import Parameters
from longarm_comp.core.at_work.row import Row
from longarm_comp.core.calibration.linear import log_mass
from longarm_comp.core.identify.posterior.found import UNNAMED

_HAZARD = 1e-3
"""Probability that something changes between two sightings: about once in a thousand moves."""
_AGAIN = 0.1
"""Probability, between two sightings, that one of the effects that changed before changes again."""
SIZES = np.array([0.1, 0.3, 1.0, 3.0])
"""Sizes of a change, in prior standard deviations of the parameter, equally likely: from hardly
visible to broken."""
_GROWN = np.array([3.0, 10.0, 30.0, 100.0])
"""Factors by which the errors may grow, equally likely, if no known effect has changed."""
_ONSETS = 16
"""Largest number of onsets (possible times of a change) that are kept. Over a thousand sightings
their ages differ by a factor of 1.6 from one to the next."""
NEGLIGIBLE = 1e-3
"""Probability below which a possible change is ignored: no sighting would show its share."""


@dataclass(frozen=True, eq=False)
class _PossibleChanges:
    """The possible changes: each of C effects and places, at each of T onsets."""

    log_weight: np.ndarray  # (T, C) log odds against "nothing changed"
    mean: np.ndarray  # (T, C, k) jump, in prior standard deviations
    spread: np.ndarray  # (T, C, k, k) covariance of the jump
    unnamed: np.ndarray  # (T, G) log odds of a change of no known effect, by growth of the errors


@dataclass(frozen=True, eq=False)
class RecursivePosterior:
    """The probability distribution of the parameters after some sightings."""

    space: Parameters  # the q parameters and C possible changes
    mean: np.ndarray
    """(q + m,) mean of the parameters if nothing changed, then of the persistent errors: r shared
    ones, in standard deviations, and each pose's own, m."""
    active: np.ndarray  # (p + m,) positions in `mean` of what is not known exactly
    covariance: np.ndarray  # (p + m, p + m) of the active ones
    changed_before: np.ndarray  # (C,) bool, whether an effect has
    since: np.ndarray  # (T,) s, time of the first sighting after each onset
    count: np.ndarray  # (T,) number of sightings since each onset
    span: np.ndarray  # (T,) number of sightings before each of which it may have been
    ruled_out: np.ndarray  # (T, C) bool, changes that other explanations follow
    response: np.ndarray  # (T, p + m, q) response of the mean's error to a unit jump
    gram: np.ndarray  # (T, C, k, k) information on a jump in prior standard deviations
    along: np.ndarray  # (T, C, k) its product with the jump that the sightings show
    growth: np.ndarray  # (T, G) log Bayes factors of grown errors
    common: int = 0  # r
    log_likelihood: float = 0.0  # of the last sighting
    surprise: float = 0.0  # how far below its highest possible value this likelihood is

    @classmethod
    def begin(
        cls,
        space: Parameters,
        mean: np.ndarray,
        active: np.ndarray,
        covariance: np.ndarray,
        common: int = 0,
    ) -> RecursivePosterior:
        """Make the posterior before the first sighting.

        Args:
            space: the parameters and their possible changes.
            mean, active, covariance: the attributes of the same names, without shared errors.
            common: the number r of shared errors, which have unit normal priors.
        """
        c, k = space.places.shape
        whole = block_diag(covariance, np.eye(common))
        return cls(
            space=space,
            mean=np.append(mean, np.zeros(common)),
            active=np.append(active, len(mean) + np.arange(common)),
            covariance=whole,
            changed_before=np.zeros(c, bool),
            since=np.zeros(0),
            count=np.zeros(0, int),
            span=np.zeros(0),
            ruled_out=np.zeros((0, c), bool),
            response=np.zeros((0, len(whole), len(space))),
            gram=np.zeros((0, c, k, k)),
            along=np.zeros((0, c, k)),
            growth=np.zeros((0, len(_GROWN))),
            common=common,
        )

    def with_anew(self, first: int, prior: np.ndarray) -> RecursivePosterior:
        """Return the posterior with the persistent errors from number `first` on reset to a prior.

        They may lie behind the last one: so the error of a further pose begins.
        """
        which = len(self.space) + first + np.arange(len(prior))
        more = max(int(which[-1]) + 1 - len(self.mean), 0)
        mean = np.append(self.mean, np.zeros(more))
        active = np.append(self.active, len(self.mean) + np.arange(more))
        covariance = block_diag(self.covariance, np.zeros((more, more)))
        response = np.pad(self.response, ((0, 0), (0, more), (0, 0)))
        own = np.searchsorted(active, which)
        mean[which] = 0.0
        covariance[own] = covariance[:, own] = response[:, own] = 0.0
        covariance[np.ix_(own, own)] = prior
        return dataclasses.replace(
            self, mean=mean, active=active, covariance=covariance, response=response
        )

    def update(self, row: Row) -> RecursivePosterior:
        """Return the posterior after one more sighting, for "nothing changed" and for every change.

        The time before this sighting becomes a new onset (possible time of a change). If there are
        now more than `_ONSETS`, the onset closest to its neighbours, relative to its age, is
        dropped.
        """
        count = len(self.space)
        columns = np.zeros((3, len(self.mean)))
        columns[:, :count] = row.columns
        columns[:, count : count + row.common.shape[1]] = row.common
        if row.place >= 0:
            at = count + self.common + 3 * row.place
            columns[:, at : at + 3] = np.eye(3)
        a = columns[:, self.active]
        carried = self.covariance @ a.T
        spread = a @ carried + row.noise
        inverse = np.linalg.inv(spread)
        gain = carried @ inverse
        off = row.value - columns @ self.mean
        response = _add_onset(self.response)
        seen = row.columns - a @ response
        response = response + gain @ seen
        # (T, 3, q) per unit -> (T, C, k, 3) of every change, per prior standard deviation
        jump = np.moveaxis((seen * self.space.widths)[:, :, self.space.places], 1, -1)
        jump = np.where((self.space.places >= 0)[None, :, :, None], jump, 0.0)
        turned = jump @ inverse
        mean = self.mean.copy()
        mean[self.active] += gain @ off
        square = float(off @ inverse @ off)
        log_det = float(np.linalg.slogdet(2.0 * math.pi * spread)[1])
        growth = 0.5 * square * (1.0 - _GROWN**-2) - 3.0 * np.log(_GROWN)
        covariance = self.covariance - gain @ carried.T
        after = dataclasses.replace(
            self,
            mean=mean,
            covariance=(covariance + covariance.T) / 2.0,
            since=np.append(self.since, row.t_s),
            count=np.append(self.count, 0) + 1,
            span=np.append(self.span, 1.0),
            ruled_out=_add_onset(self.ruled_out),
            response=response,
            gram=_add_onset(self.gram) + turned @ np.swapaxes(jump, -1, -2),
            along=_add_onset(self.along) + turned @ off,
            growth=_add_onset(self.growth) + growth,
        )
        surprise = 0.5 * square + self.total - after.total
        if len(after.since) > _ONSETS:
            after = after._without_an_onset()
        return dataclasses.replace(
            after, log_likelihood=-0.5 * log_det - surprise, surprise=surprise
        )

    def _without_an_onset(self) -> RecursivePosterior:
        """Return the posterior without the onset that is least apart for its age.

        The next later one stands for it.
        """
        count, span = self.count, self.span.copy()
        dropped = 1 + int(((count[:-2] - count[2:]) / count[1:-1]).argmin())
        span[dropped + 1] += span[dropped]
        kept = np.arange(len(count)) != dropped
        names = ("since", "count", "ruled_out", "response", "gram", "along", "growth")
        thinner = {name: getattr(self, name)[kept] for name in names}
        return dataclasses.replace(self, span=span[kept], **thinner)

    @cached_property
    def possible(self) -> _PossibleChanges:
        """The possible changes, averaged over all `SIZES`, with the parameters inside bounds."""
        values, turn = np.linalg.eigh(self.gram)
        z = np.einsum("tcik,tci->tck", turn, self.along)[:, :, None, :]
        square = SIZES[:, None] ** 2
        grown = 1.0 + square * np.maximum(values, 0.0)[:, :, None, :]
        share = square / grown  # (T, C, S, k)
        evidence = 0.5 * (share * z**2).sum(-1) - 0.5 * np.log(grown).sum(-1)
        means = np.einsum("tcik,tcsk->tcsi", turn, share * z)
        # (C, 1, k) least and largest jump, so that every parameter stays within its bounds
        now = self.mean[: len(self.space)]
        least, most = ((b - now) / self.space.widths for b in self.space.bounds)
        places, used = self.space.places, self.space.places >= 0
        lower = np.where(used, np.minimum(least, 0.0)[places], -np.inf)[:, None, :]
        upper = np.where(used, np.maximum(most, 0.0)[places], np.inf)[:, None, :]
        sd = np.sqrt(np.einsum("tcik,tcsk->tcsi", turn**2, share))
        inside = log_mass((lower - means) / sd, (upper - means) / sd)
        scale = SIZES[:, None]
        evidence = evidence + (inside - log_mass(lower / scale, upper / scale)).sum(-1)
        top = evidence.max(-1, initial=-np.inf, keepdims=True)
        chance = np.exp(evidence - top)
        factor = top[..., 0] + np.log(chance.mean(-1))
        chance /= chance.sum(-1, keepdims=True)
        mean = np.clip(means, lower, upper)
        middle = np.einsum("tcs,tcsi->tci", chance, mean)
        spread = np.einsum(
            "tcik,tck,tcjk->tcij", turn, np.einsum("tcs,tcsk->tck", chance, share), turn
        )
        log_prior = self.space.log_prior + math.log(_HAZARD * (1.0 - UNNAMED))
        if self.changed_before.any():
            more = math.log(_AGAIN / self.changed_before.sum())
            log_prior = np.where(self.changed_before, np.maximum(log_prior, more), log_prior)
        log_span = np.log(self.span)[:, None]
        unnamed = self.growth + math.log(_HAZARD * UNNAMED / len(_GROWN)) + log_span
        log_weight = np.where(self.ruled_out, -np.inf, factor + log_prior + log_span)
        return _PossibleChanges(log_weight, middle, spread, unnamed)

    @property
    def total(self) -> float:
        """The log of the sum of all possibilities' weights; "nothing changed" has weight 1."""
        p = self.possible
        top = max(float(p.log_weight.max(initial=0.0)), float(p.unnamed.max(initial=0.0)))
        whole = math.exp(-top) + np.exp(p.log_weight - top).sum() + np.exp(p.unnamed - top).sum()
        return top + math.log(whole)

    @cached_property
    def probability(self) -> np.ndarray:
        """The (T, C) probability of every change at every onset."""
        return np.asarray(np.exp(self.possible.log_weight - self.total))

    @property
    def chance_unexplained(self) -> float:
        """Probability that something changed that no known effect explains."""
        return float(np.exp(self.possible.unnamed - self.total).sum())

    @property
    def error_growth(self) -> float:
        """The factor by which the square of the errors has grown: its mean, 1 if nothing changed.

        It is averaged over the changes of no known effect (`_GROWN`).
        """
        grown = np.exp(self.possible.unnamed - self.total).sum(axis=0)
        return 1.0 + float(grown @ (_GROWN**2 - 1.0))

    def _describe_jump(self, t: int, c: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions (k,) and mean jump (k,) of the parameters of change c at onset t.

        The derivatives (q + m, k) of `mean` by the jump come third.
        """
        places = np.array(self.space.own(c))
        jump = self.possible.mean[t, c, : len(places)] * self.space.widths[places]
        follows = np.zeros((len(self.mean), len(places)))
        follows[self.active] = -self.response[t][:, places]
        follows[places, np.arange(len(places))] += 1.0
        return places, jump, follows

    def value_before(self, t: int, c: int) -> np.ndarray:
        """Return the (k,) parameters of an effect before change c, if it came at onset t."""
        places, jump, follows = self._describe_jump(t, c)
        return np.asarray(self.mean[places] + follows[places] @ jump - jump)

    @cached_property
    def expected_values(self) -> np.ndarray:
        """The mean (q,) of the parameters, averaged over all possible changes and none."""
        return self._moments[0][: len(self.space)]

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (p,) of the uncertain parameters, and their covariance (p, p).

        The covariance is over all possible changes and none.
        """
        _, uncertain, covariance = self._moments
        active = uncertain[uncertain < len(self.space)]
        return active, covariance[: len(active), : len(active)]

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The moments of `_moments_over`, over all possible changes and none."""
        likely = np.argwhere(self.probability > NEGLIGIBLE).tolist()
        return self._moments_over({(t, c): float(self.probability[t, c]) for t, c in likely})

    def _moments_over(
        self, weights: Mapping[tuple[int, int], float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the moments of parameters and persistent errors over some of the changes.

        They are the mean (q + m,), the positions (a,) of what is uncertain, and its covariance.

        Args:
            weights: probability by (onset, change); no change has 1 less their sum.
        """
        jumps = {at: self._describe_jump(*at) for at in weights}
        off = {at: follows @ jump for at, (_, jump, follows) in jumps.items()}
        mean = self.mean + sum(weight * off[at] for at, weight in weights.items())
        changed = [places for places, _, _ in jumps.values()]
        active = np.unique(np.concatenate([self.active, *changed])).astype(int)
        before = np.isin(active, self.active)
        covariance = np.zeros((len(active), len(active)))
        covariance[np.ix_(before, before)] = self.covariance
        away = (self.mean - mean)[active]
        covariance += max(1.0 - sum(weights.values()), 0.0) * np.outer(away, away)
        for (t, c), weight in weights.items():
            places, _, follows = jumps[t, c]
            spread = self.possible.spread[t, c][: len(places), : len(places)]
            carried = follows[active] * self.space.widths[places]
            away = (self.mean + off[t, c] - mean)[active]
            covariance += weight * (carried @ spread @ carried.T + np.outer(away, away))
        return mean, active, covariance

    def given_change(self, c: int) -> RecursivePosterior:
        """Return the posterior, given that change c has happened.

        Its onsets are merged into one mean and covariance. The search for further changes begins
        again.
        """
        chance = self.probability[:, c] / max(float(self.probability[:, c].sum()), 1e-300)
        likely = {(t, c): float(p) for t, p in enumerate(chance) if p > NEGLIGIBLE}
        whole, changed = sum(likely.values()), self.changed_before.copy()
        changed[c] = True
        moments = self._moments_over({at: p / whole for at, p in likely.items()})
        begun = RecursivePosterior.begin(self.space, *moments)
        return dataclasses.replace(begun, changed_before=changed, common=self.common)

    def mixed_with(self, other: RecursivePosterior, share: float) -> RecursivePosterior:
        """Return the posterior with mean and covariance of a mixture with another one.

        Args:
            other: a posterior after the same sightings, of the same active parameters. The possible
                changes are not taken from it.
            share: its probability.
        """
        off = other.mean - self.mean
        away = off[self.active]
        covariance = (1.0 - share) * self.covariance + share * other.covariance
        covariance = covariance + share * (1.0 - share) * np.outer(away, away)
        return dataclasses.replace(self, mean=self.mean + share * off, covariance=covariance)

    def without_changes(self, which: Sequence[int]) -> RecursivePosterior:
        """Return the posterior, given that none of some changes has happened until now."""
        ruled_out = self.ruled_out.copy()
        ruled_out[:, which] = True
        return dataclasses.replace(self, ruled_out=ruled_out)


def _add_onset(before: np.ndarray) -> np.ndarray:
    """Return an array (T, ...) with a row of zeros for one more onset, (T + 1, ...)."""
    return np.concatenate([before, np.zeros((1, *before.shape[1:]), before.dtype)])
