"""The recursive posterior: a Kalman filter, and beside it what follows if an effect has changed.

"Nothing changed" is one Kalman filter over the model's parameters, without process noise.  "Effect
c changed before sighting t" differs from it by a known linear response to the unknown jump. A
recursion carries that response along (Willsky and Jones 1976, IEEE Trans. Automatic Control 21), so
that hundreds of such changes cost one filter.  Each has its evidence.  A drift is a row of jumps.

What no parameter explains is alike whenever the arm comes to a pose.  Counted anew at each visit it
would be learned as a fault of the arm, so the filter follows this error at the last poses too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from longarm_comp.core.at_work.changes import Parameters
from longarm_comp.core.calibration.linear import log_mass
from longarm_comp.core.identify.posterior.found import UNNAMED

_HAZARD = 1e-3
"""Probability that something changes between two moves: about once in ten days of a hundred."""
_AGAIN = 0.1
"""The same of what has changed already: what wears, wears on."""
SIZES = np.array([0.1, 0.3, 1.0, 3.0])
"""Of a change, in ordinary sizes of the parameter, equally likely: from what begins to
show to what breaks."""
_GROWN = np.array([3.0, 10.0, 30.0, 100.0])
"""Growths of the errors, equally likely, that stand for a change of no known effect."""
_ONSETS = 16
"""Times of a change that are carried along: over a thousand sightings by a factor of 1.6 apart."""
NEGLIGIBLE = 1e-3
"""Probability below which a possible change moves no parameter: less than any sighting sees."""


@dataclass(frozen=True, eq=False)
class Row:
    """One sighting, as an equation of all parameters."""

    t_s: float
    columns: np.ndarray  # (3, q) m per unit
    value: np.ndarray  # (3,) m, the sighting less what the numbers at 0 would give, to first order
    noise: np.ndarray  # (3, 3) m^2
    reach: float  # distance from the base, m
    pose: np.ndarray | None = None  # (n,) joints, in shares of their ranges
    structure: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) m^2, of the error that each visit to the pose shares."""
    place: int = -1  # of this pose among those whose own error is followed
    is_new: bool = False  # whether the arm comes to this pose for the first time

    def log_doubt(self, expected: np.ndarray) -> float:
        """Return the log density of a wrong sighting where parameters (q,) are expected.

        A wrong one is off by any order of magnitude alike, from the scatter to the reach.
        """
        scatter = math.sqrt(float(np.trace(self.noise)))
        off = max(float(np.linalg.norm(self.value - self.columns @ expected)), scatter)
        orders = math.log(max(self.reach / scatter, math.e))
        return -math.log(4.0 * math.pi * orders) - 3.0 * math.log(off)


@dataclass(frozen=True, eq=False)
class _PossibleChanges:
    """The possible changes: of every effect at every onset."""

    log_weight: np.ndarray  # (T, C) against "nothing changed"
    mean: np.ndarray  # (T, C, k) jump in ordinary sizes
    spread: np.ndarray  # (T, C, k, k) its covariance
    unnamed: np.ndarray  # (T, G) log weight of a change of no known effect, by growth


@dataclass(frozen=True, eq=False)
class RecursivePosterior:
    """The knowledge after some sightings."""

    space: Parameters  # the numbers
    mean: np.ndarray  # (q,) if nothing changed
    active: np.ndarray  # (p,) positions of what is not known exactly
    covariance: np.ndarray  # (p + 3k, p + 3k) of these, and of the errors of k poses
    again: np.ndarray  # (C,) whether an effect has changed before
    since: np.ndarray  # (T,) first sighting's time of each onset
    count: np.ndarray  # (T,) sightings since
    response: np.ndarray  # (T, p + 3k, q) of the mean's error to a unit jump
    gram: np.ndarray  # (T, C, k, k),
    along: np.ndarray  # (T, C, k), of a jump in ordinary sizes, against the noise
    growth: np.ndarray  # (T, G) log Bayes factors of grown errors
    beside: np.ndarray  # (3k,) m, what no parameter explains, by pose
    structure: np.ndarray  # (3, 3) m^2, how large that is
    log_likelihood: float = 0.0  # of the last sighting
    surprise: float = 0.0  # how much less that is than the most that was possible

    @classmethod
    def begin(
        cls, space: Parameters, mean: np.ndarray, active: np.ndarray, covariance: np.ndarray
    ) -> RecursivePosterior:
        """Begin without a sighting, from a mean, the active parameters and a covariance.

        The arguments are the attributes of the same names.
        """
        c, k = space.places.shape
        return cls(
            space=space,
            mean=mean,
            active=active,
            covariance=covariance,
            again=np.zeros(c, bool),
            since=np.zeros(0),
            count=np.zeros(0, int),
            response=np.zeros((0, len(active), len(space))),
            gram=np.zeros((0, c, k, k)),
            along=np.zeros((0, c, k)),
            growth=np.zeros((0, len(_GROWN))),
            beside=np.zeros(0),
            structure=np.zeros((3, 3)),
        )

    def at_new_place(self, place: int, structure: np.ndarray) -> RecursivePosterior:
        """Return it where nothing is known of a pose's own error but its size (3, 3), m^2.

        Args:
            place: at most k; what was known of the pose that had it is forgotten.
        """
        p, known = len(self.active), len(self.covariance)
        own = slice(p + 3 * place, p + 3 * place + 3)
        whole = max(known, own.stop)
        covariance = np.zeros((whole, whole))
        covariance[:known, :known] = self.covariance
        covariance[own] = covariance[:, own] = 0.0
        covariance[own, own] = structure
        response = np.zeros((len(self.response), whole, len(self.space)))
        response[:, :known] = self.response
        response[:, own] = 0.0
        beside = np.zeros(whole - p)
        beside[: len(self.beside)] = self.beside
        beside[3 * place : 3 * place + 3] = 0.0
        return dataclasses.replace(
            self, covariance=covariance, response=response, beside=beside, structure=structure
        )

    def update(self, row: Row) -> RecursivePosterior:
        """Update "nothing changed", and every change at every onset, with a sighting."""
        own = np.zeros((3, len(self.beside)))
        if row.place >= 0:
            own[:, 3 * row.place : 3 * row.place + 3] = np.eye(3)
        a = np.concatenate([row.columns[:, self.active], own], axis=1)
        carried = self.covariance @ a.T
        spread = a @ carried + row.noise
        inverse = np.linalg.inv(spread)
        gain = carried @ inverse
        off = row.value - row.columns @ self.mean - own @ self.beside
        response = _add_onset(self.response)
        seen = row.columns - a @ response
        response = response + gain @ seen
        # (T, 3, q) per unit -> (T, C, k, 3) of every change, per ordinary size
        jump = np.moveaxis((seen * self.space.widths)[:, :, self.space.places], 1, -1)
        jump = np.where((self.space.places >= 0)[None, :, :, None], jump, 0.0)
        turned = jump @ inverse
        mean, moved = self.mean.copy(), gain @ off
        mean[self.active] += moved[: len(self.active)]
        square = float(off @ inverse @ off)
        log_det = float(np.linalg.slogdet(2.0 * math.pi * spread)[1])
        growth = 0.5 * square * (1.0 - _GROWN**-2) - 3.0 * np.log(_GROWN)
        covariance = self.covariance - gain @ carried.T
        after = dataclasses.replace(
            self,
            mean=mean,
            beside=self.beside + moved[len(self.active) :],
            covariance=(covariance + covariance.T) / 2.0,
            since=np.append(self.since, row.t_s),
            count=np.append(self.count, 0) + 1,
            response=response,
            gram=_add_onset(self.gram) + turned @ np.swapaxes(jump, -1, -2),
            along=_add_onset(self.along) + turned @ off,
            growth=_add_onset(self.growth) + growth,
        )
        surprise = 0.5 * square + self.total - after.total
        if len(after.since) > _ONSETS:  # without the one that is least apart for its age
            count = after.count
            apart = (count[:-2] - count[2:]) / count[1:-1]
            kept = np.arange(len(count)) != 1 + int(apart.argmin())
            names = ("since", "count", "response", "gram", "along", "growth")
            thinner = {name: getattr(after, name)[kept] for name in names}
            after = dataclasses.replace(after, **thinner)
        return dataclasses.replace(
            after, log_likelihood=-0.5 * log_det - surprise, surprise=surprise
        )

    @cached_property
    def possible(self) -> _PossibleChanges:
        """The possible changes of every effect at every onset, over all `SIZES` inside bounds."""
        values, turn = np.linalg.eigh(self.gram)
        z = np.einsum("tcik,tci->tck", turn, self.along)[:, :, None, :]
        square = SIZES[:, None] ** 2
        grown = 1.0 + square * np.maximum(values, 0.0)[:, :, None, :]
        share = square / grown  # (T, C, S, k)
        evidence = 0.5 * (share * z**2).sum(-1) - 0.5 * np.log(grown).sum(-1)
        means = np.einsum("tcik,tcsk->tcsi", turn, share * z)
        # (C, 1, k) least and largest jump, so that every number stays in its bounds
        least, most = ((b - self.mean) / self.space.widths for b in self.space.bounds)
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
        if self.again.any():
            more = math.log(_AGAIN / self.again.sum())
            log_prior = np.where(self.again, np.maximum(log_prior, more), log_prior)
        unnamed = self.growth + math.log(_HAZARD * UNNAMED / len(_GROWN))
        return _PossibleChanges(factor + log_prior, middle, spread, unnamed)

    @property
    def total(self) -> float:
        """The log of the sum of all weights, where "nothing changed" has weight 1."""
        h = self.possible
        top = max(float(h.log_weight.max(initial=0.0)), float(h.unnamed.max(initial=0.0)))
        whole = math.exp(-top) + np.exp(h.log_weight - top).sum() + np.exp(h.unnamed - top).sum()
        return top + math.log(whole)

    @cached_property
    def probability(self) -> np.ndarray:
        """The probability of every change at every onset, (T, C)."""
        return np.asarray(np.exp(self.possible.log_weight - self.total))

    @property
    def unexplained(self) -> float:
        """Probability that something changed that no known effect explains."""
        return float(np.exp(self.possible.unnamed - self.total).sum())

    @property
    def grown(self) -> float:
        """How much the square of the errors has grown, on average over these growths and none."""
        grown = np.exp(self.possible.unnamed - self.total).sum(axis=0)
        return 1.0 + float(grown @ (_GROWN**2 - 1.0))

    def _describe_jump(self, t: int, c: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return a change's positions, its mean jump (k,), and how parameters follow it, (q, k)."""
        places = np.array(self.space.own(c))
        jump = self.possible.mean[t, c, : len(places)] * self.space.widths[places]
        follows = np.zeros((len(self.space), len(places)))
        follows[self.active] = -self.response[t][: len(self.active), places]
        follows[places, np.arange(len(places))] += 1.0
        return places, jump, follows

    def value_before(self, t: int, c: int) -> np.ndarray:
        """Return the values (k,) that an effect's parameters had until it changed at an onset."""
        places, jump, follows = self._describe_jump(t, c)
        return np.asarray(self.mean[places] + follows[places] @ jump - jump)

    @cached_property
    def expected(self) -> np.ndarray:
        """The mean of the parameters over all possible changes and none, (q,)."""
        made = self.mean.copy()
        for t, c in np.argwhere(self.probability > NEGLIGIBLE):
            _, jump, follows = self._describe_jump(t, c)
            made += self.probability[t, c] * (follows @ jump)
        return made

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (p,) of what is not known exactly, and its covariance (p, p) over all possible
        changes and none."""
        likely = {
            (t, c): float(self.probability[t, c])
            for t, c in np.argwhere(self.probability > NEGLIGIBLE).tolist()
        }
        return self._covariance_over(likely, self.expected)

    @cached_property
    def within_bounds(self) -> np.ndarray:
        """The most probable parameters within their bounds, (q,)."""
        return self.space.most_probable(self.expected, *self.spread)

    def _covariance_over(
        self, weights: Mapping[tuple[int, int], float], mean: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and covariance, as `spread`, over some changes (onset, effect).

        Args:
            weights: the probability of each; what is missing to 1 is that of no change.
            mean: (q,) of the parameters over these.
        """
        changed = [self.space.own(c) for _, c in weights]
        active = np.unique(np.concatenate([self.active, *changed])).astype(int)
        covariance = np.zeros((len(active), len(active)))
        before = np.isin(active, self.active)
        known = len(self.active)
        covariance[np.ix_(before, before)] = self.covariance[:known, :known]
        off = (self.mean - mean)[active]
        covariance += max(1.0 - sum(weights.values()), 0.0) * np.outer(off, off)
        for (t, c), weight in weights.items():
            places, jump, follows = self._describe_jump(t, c)
            own = self.possible.spread[t, c][: len(places), : len(places)]
            carried = follows[active] * self.space.widths[places]
            off = (self.mean + follows @ jump - mean)[active]
            covariance += weight * (carried @ own @ carried.T + np.outer(off, off))
        return active, covariance

    def given_change(self, c: int) -> RecursivePosterior:
        """Return the posterior if an effect has changed: its onsets are merged, other changes begin
        again."""
        chance = self.probability[:, c] / max(float(self.probability[:, c].sum()), 1e-300)
        likely = {(t, c): float(p) for t, p in enumerate(chance) if p > NEGLIGIBLE}
        whole = sum(likely.values())
        weights = {at: p / whole for at, p in likely.items()}
        jumps = {at: self._describe_jump(*at) for at in weights}
        mean = self.mean + sum(p * (jumps[at][2] @ jumps[at][1]) for at, p in weights.items())
        active, covariance = self._covariance_over(weights, mean)
        again = self.again.copy()
        again[c] = True
        begun = RecursivePosterior.begin(self.space, mean, active, covariance)
        for place in range(len(self.beside) // 3):
            begun = begun.at_new_place(place, self.structure)
        return dataclasses.replace(begun, again=again)


def _add_onset(before: np.ndarray) -> np.ndarray:
    """Add one more onset, of which nothing is known."""
    return np.concatenate([before, np.zeros((1, *before.shape[1:]))])
