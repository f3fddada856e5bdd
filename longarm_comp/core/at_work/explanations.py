"""Posteriors side by side, one for each explanation of what has changed so far.

Where something changed, the posterior splits into one for each effect that may have changed
(generalised pseudo-Bayes; Tugnait 1982, Automatica 18). Each goes on as a Kalman filter of its own,
in which further changes can begin.  Their weights follow from how well each predicts.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.at_work.changes import Key, Parameters
from longarm_comp.core.at_work.posterior import NEGLIGIBLE, RecursivePosterior, Row
from longarm_comp.core.calibration.linear import most_probable_within
from longarm_comp.core.identify.posterior.found import CREDIBLE

MOST = 4
"""Explanations that are carried along: each costs as much time as the first."""
DOUBT = 0.01
"""Probability that a sighting is wrong, and with which explanations may be forgotten."""
_FEWEST, _LATEST = 2, 15
"""Sightings of a change after which posteriors part: at least, as one alone may be wrong; at last,
as its jump is then known four times better than by one."""


@dataclass(frozen=True)
class _PastChange:
    """A change of an effect that one explanation takes for certain."""

    key: Key
    where: str
    since_s: float  # time of the first sighting that shows it
    sightings: int  # from then until posteriors parted
    before: tuple[float, ...]  # (k,) values of its parameters until then


@dataclass(frozen=True, eq=False)
class Branch:
    """One explanation: its weight, its posterior, and the changes that are certain, in order."""

    weight: float
    known: RecursivePosterior
    changes: tuple[_PastChange, ...] = ()

    def split(self) -> Iterator[Branch]:
        """Yield one branch for each effect that may have changed, or only this one while the
        sightings do not tell yet."""
        known = self.known
        chance = known.probability.sum(axis=0)
        some = float(chance.sum())
        order = np.argsort(-chance)[:MOST]
        sure = some > CREDIBLE and known.unexplained < NEGLIGIBLE + 0.5 * some
        count = known.count[int(known.probability[:, order[0]].argmax())] if sure else 0
        few = sure and chance[order].sum() >= (1.0 - DOUBT) * some and count >= _FEWEST
        if not (few or count >= _LATEST):
            yield self
            return
        whole, past = float(chance[order].sum()), {change.key for change in self.changes}
        for c in order.tolist():
            if chance[c] <= NEGLIGIBLE * whole:
                continue
            key, changes = known.space.keys[c], self.changes
            if key not in past:
                own, t = known.space.own(c), int(known.probability[:, c].argmax())
                changes += (
                    _PastChange(
                        key=key,
                        where=known.space.slots[own[0]].owner.where,
                        since_s=float(known.since[t]),
                        sightings=int(known.count[t]),
                        before=tuple(known.mean[own].tolist()),
                    ),
                )
            yield Branch(self.weight * float(chance[c]) / whole, known.given_change(c), changes)


@dataclass(frozen=True, eq=False)
class Explanations:
    """All explanations, with weights that sum to 1."""

    branches: tuple[Branch, ...]  # the most probable first
    log_likelihood: float = 0.0  # of the last sighting

    @property
    def space(self) -> Parameters:
        """The parameters of the model and of all possible changes."""
        return self.branches[0].known.space

    def update(self, row: Row) -> Explanations:
        """Return the explanations weighed again with one more sighting."""
        each = [(b, b.known.update(row)) for b in self.branches]
        logs = np.array([math.log(b.weight) + known.log_likelihood for b, known in each])
        top = float(logs.max())
        likelihood = top + math.log(float(np.exp(logs - top).sum()))
        weights = np.exp(logs - likelihood).tolist()
        made = [
            part
            for (b, known), w in zip(each, weights, strict=True)
            if w > NEGLIGIBLE
            for part in Branch(w, known, b.changes).split()
        ]
        if len(made) > MOST:  # of each set of changes the most probable one, with all weight
            merged: dict[frozenset[Key], Branch] = {}
            for b in sorted(made, key=lambda b: b.weight):
                keys = frozenset(c.key for c in b.changes)
                whole = b.weight + (merged[keys].weight if keys in merged else 0.0)
                merged[keys] = dataclasses.replace(b, weight=whole)
            made = list(merged.values())
        kept = sorted(made, key=lambda b: -b.weight)[:MOST]
        whole = sum(b.weight for b in kept)
        return Explanations(
            tuple(dataclasses.replace(b, weight=b.weight / whole) for b in kept), likelihood
        )

    @cached_property
    def expected(self) -> np.ndarray:
        """The mean of the parameters over all explanations, (q,)."""
        return np.sum([b.weight * b.known.expected for b in self.branches], axis=0)

    @cached_property
    def covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """The positions (p,) of the uncertain parameters, and their covariance (p, p)."""
        active = np.unique(np.concatenate([b.known.active for b in self.branches]))
        made = np.zeros((len(active), len(active)))
        for b in self.branches:
            own = np.isin(active, b.known.active)
            off = (b.known.expected - self.expected)[active]
            made += b.weight * np.outer(off, off)
            made[np.ix_(own, own)] += b.weight * b.known.covariance
        return active, made

    @cached_property
    def within_bounds(self) -> np.ndarray:
        """The most probable parameters within their bounds, (q,)."""
        active, covariance = self.covariance
        made = np.clip(self.expected, *self.space.bounds)
        lower, upper = (bound[active] for bound in self.space.bounds)
        made[active] = most_probable_within(self.expected[active], covariance, lower, upper)
        return made

    @property
    def unexplained(self) -> float:
        """Probability that something changed that no known effect explains."""
        return sum(b.weight * b.known.unexplained for b in self.branches)

    @cached_property
    def places(self) -> dict[str, float]:
        """The probability that something has changed, by place."""
        made: dict[str, float] = {}
        for b in self.branches:
            for place in {c.where for c in b.changes}:
                made[place] = made.get(place, 0.0) + b.weight
        return made
