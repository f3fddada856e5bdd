"""Posteriors side by side, one for each explanation of what has changed so far.

Where something changed, the posterior splits into one for each effect that may have changed
(generalised pseudo-Bayes; Tugnait 1982, Automatica 18). Each goes on as a Kalman filter of its own,
in which further changes can begin.  Their weights follow from how well each predicts.

A sighting that surprises may be wrong.  Then two go on, one with it and one without it, until later
sightings decide (multiple hypotheses; Reid 1979, IEEE Trans. Automatic Control 24).
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
from longarm_comp.core.identify.posterior.found import CREDIBLE

MOST = 4
"""Explanations that are carried along: each costs as much time as the first."""
DOUBT = 0.01
"""Probability that a sighting is wrong, and with which explanations may be forgotten."""
VISITED, ALIKE = 16, 0.05
"""Poses whose own errors are followed, the last ones; no joint differs by more than this share of
its range where poses count as one."""
SURPRISE = -math.log(DOUBT)
"""Surprise from which on a sighting may be wrong: it is as rare as a wrong one."""
_PATIENCE = 10
"""Sightings for which both are kept that differ about one that surprised."""
_HOPELESS = 1e-20
"""Probability below which they are not: two sightings that one alone explains raise it so far."""
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
    """One explanation.

    Attributes:
        weight: its probability.
        known: its posterior.
        changes: the changes that are certain, in order.
        left_out: number of sightings that are wrong by it.
        age: sightings since another explanation differs about one that surprised.
    """

    weight: float
    known: RecursivePosterior
    changes: tuple[_PastChange, ...] = ()
    left_out: int = 0
    age: int = _PATIENCE

    def judge(self, row: Row) -> Iterator[tuple[float, Branch]]:
        """Yield the explanation with a sighting taken in, and without one that may be wrong.

        Each comes with the log of its weight times the likelihood of the sighting.
        """
        before = self.known.at_new_place(row.place, row.structure) if row.is_new else self.known
        known, weight = before.update(row), math.log(self.weight)
        wrong = known.surprise > SURPRISE
        age = 0 if wrong else self.age + 1
        taken = dataclasses.replace(self, known=known, age=age)
        yield weight + math.log1p(-DOUBT) + known.log_likelihood, taken
        if wrong:
            doubt = weight + math.log(DOUBT) + row.log_doubt(self.known.expected)
            left_out = self.left_out + 1
            yield doubt, dataclasses.replace(self, known=before, left_out=left_out, age=age)

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
                t = int(known.probability[:, c].argmax())
                changes += (
                    _PastChange(
                        key=key,
                        where=known.space.where(c),
                        since_s=float(known.since[t]),
                        sightings=int(known.count[t]),
                        before=tuple(known.value_before(t, c).tolist()),
                    ),
                )
            yield dataclasses.replace(
                self,
                weight=self.weight * float(chance[c]) / whole,
                known=known.given_change(c),
                changes=changes,
            )


@dataclass(frozen=True, eq=False)
class Explanations:
    """All explanations, with weights that sum to 1."""

    branches: tuple[Branch, ...]  # the most probable first
    visited: tuple[tuple[int, np.ndarray], ...] = ()
    """The poses whose own errors are followed, each with its place, the latest last."""

    @property
    def left_out(self) -> int:
        """Number of sightings that are wrong by the most probable explanation."""
        return self.branches[0].left_out

    @property
    def space(self) -> Parameters:
        """The parameters of the model and of all possible changes."""
        return self.branches[0].known.space

    def update(self, row: Row) -> Explanations:
        """Return the explanations weighed again with one more sighting."""
        row, visited = self._visit(row)
        each = [judged for b in self.branches for judged in b.judge(row)]
        logs = np.array([log for log, _ in each])
        top = float(logs.max())
        weights = (np.exp(logs - top) / np.exp(logs - top).sum()).tolist()
        made = [
            part
            for (_, b), w in zip(each, weights, strict=True)
            if w > (_HOPELESS if b.age < _PATIENCE else NEGLIGIBLE)
            for part in dataclasses.replace(b, weight=w).split()
        ]
        if len(made) > MOST:  # of each set of changes the most probable one, with all weight
            merged: dict[tuple[frozenset[Key], int], Branch] = {}
            for b in sorted(made, key=lambda b: b.weight):
                keys = frozenset(c.key for c in b.changes), b.left_out
                whole = b.weight + (merged[keys].weight if keys in merged else 0.0)
                merged[keys] = dataclasses.replace(b, weight=whole)
            made = list(merged.values())
        kept = sorted(made, key=lambda b: -b.weight)[:MOST]
        whole = sum(b.weight for b in kept)
        branches = tuple(dataclasses.replace(b, weight=b.weight / whole) for b in kept)
        return Explanations(branches, visited)

    def _visit(self, row: Row) -> tuple[Row, tuple[tuple[int, np.ndarray], ...]]:
        """Find the place of a sighting's pose, which may be that of the pose that is oldest."""
        if row.pose is None:
            return row, self.visited
        for known in self.visited:
            if np.abs(known[1] - row.pose).max() < ALIKE:
                others = tuple(each for each in self.visited if each is not known)
                return dataclasses.replace(row, place=known[0]), (*others, known)
        full = len(self.visited) == VISITED
        place = self.visited[0][0] if full else len(self.visited)
        visited = (*self.visited[full:], (place, row.pose))
        return dataclasses.replace(row, place=place, is_new=True), visited

    @cached_property
    def expected(self) -> np.ndarray:
        """The mean of the parameters over all explanations, (q,)."""
        return np.sum([b.weight * b.known.expected for b in self.branches], axis=0)

    @cached_property
    def covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """The positions (p,) of the uncertain parameters, and their covariance (p, p)."""
        active = np.unique(np.concatenate([b.known.spread[0] for b in self.branches]))
        made = np.zeros((len(active), len(active)))
        for b in self.branches:
            places, covariance = b.known.spread
            own = np.isin(active, places)
            off = (b.known.expected - self.expected)[active]
            made += b.weight * np.outer(off, off)
            made[np.ix_(own, own)] += b.weight * covariance
        return active, made

    @cached_property
    def within_bounds(self) -> np.ndarray:
        """The most probable parameters within their bounds, (q,)."""
        return self.space.most_probable(self.expected, *self.covariance)

    def chance_of_knock(self, columns: np.ndarray, least: float) -> float:
        """Return the probability that base or tip, or what measures them, stands elsewhere.

        Args:
            columns: (3, q) m per unit, of a sighting.
            least: shift there that counts, m.
        """
        made, space = 0.0, self.space
        for b in self.branches:
            off = np.zeros(len(space))
            for change in b.changes:
                if space.knocks[c := space.keys.index(change.key)]:
                    own = space.own(c)
                    off[own] = b.known.expected[own] - change.before
            gone = float(np.linalg.norm(columns @ off)) > least
            made += b.weight * (1.0 if gone else b.known.probability[:, space.knocks].sum())
        return made

    @property
    def disputed(self) -> bool:
        """True if the last sighting surprised, and it is open whether it is wrong."""
        first = self.branches[0]
        other = sum(b.weight for b in self.branches if b.left_out != first.left_out)
        return first.age == 0 and other > NEGLIGIBLE

    @property
    def grown(self) -> float:
        """How much the square of the errors that no parameter explains has grown."""
        return sum(b.weight * b.known.grown for b in self.branches)

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
