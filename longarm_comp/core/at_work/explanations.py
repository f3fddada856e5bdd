"""Posteriors side by side, one for each explanation of what has changed so far.

If something changed, the posterior splits into one for each effect that may have changed
(generalised pseudo-Bayes; Tugnait 1982, Automatica 18). Each is then a Kalman filter of its own, in
which further changes can begin.  The better an explanation predicts, the more its weight grows.

A surprising sighting may be wrong.  Then two explanations are kept, one with it and one without it,
until later sightings decide (multiple hypotheses; Reid 1979, IEEE Trans. Automatic Control 24).
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.at_work.changes import Key, Parameters
from longarm_comp.core.at_work.posterior import NEGLIGIBLE, RecursivePosterior
from longarm_comp.core.at_work.row import Row
from longarm_comp.core.compensation.sighting import visit
from longarm_comp.core.identify.posterior.found import CREDIBLE
from longarm_comp.core.yaml_file import Declared

MOST = 4
"""Largest number of explanations that are kept. Each takes as much computing time as the first."""
DOUBT = 0.01
"""Probability that a sighting is wrong. Also the probability of rare changes that may be left out
when a posterior splits."""
SURPRISE = -math.log(DOUBT)
"""Surprise above which a sighting may be wrong: a larger one is as rare as a wrong sighting."""
_PATIENCE = 10
"""Number of sightings for which explanations with and without a surprising sighting are kept."""
_HOPELESS = 1e-20
"""Probability below which an explanation is dropped even within `_PATIENCE` sightings of a
surprising one. Two sightings that it alone explains can raise its probability from there."""
_FEWEST, _LATEST = 2, 15
"""Number of sightings after a change at which the posterior splits: at least 2, as one may be
wrong; at the latest 15, when the jump is known four times better than after one."""


@dataclass(frozen=True)
class _PastChange:
    """A change of an effect, if one explanation takes this change for certain."""

    key: Key
    where: str
    since_s: float  # time of the first sighting that shows it
    sightings: int  # number from then until the posterior split
    before: tuple[float, ...]  # (k,) values of its parameters before the change


@dataclass(frozen=True, eq=False)
class Branch:
    """One explanation of the sightings: the changes so far, and the posterior that follows."""

    weight: float  # its probability
    posterior: RecursivePosterior  # its posterior
    changes: tuple[_PastChange, ...] = ()  # the changes that it takes for certain, in order
    left_out: int = 0  # number of sightings that it takes for wrong
    age: int = _PATIENCE  # number of sightings since the last surprising one

    def judge(self, row: Row) -> Iterator[tuple[float, Branch]]:
        """Yield the explanation after a sighting, and, if that surprises, also without it.

        Each comes with the log of its weight times the likelihood of the sighting.
        """
        before = self.posterior
        if row.is_new:
            before = before.with_anew(before.common + 3 * row.place, row.structure)
        for which in row.anew:
            before = before.with_anew(which, np.eye(1))
        posterior, weight = before.update(row), math.log(self.weight)
        wrong = posterior.surprise > SURPRISE
        age = 0 if wrong else self.age + 1
        taken = dataclasses.replace(self, posterior=posterior, age=age)
        yield weight + math.log1p(-DOUBT) + posterior.log_likelihood, taken
        if wrong:
            doubt = weight + math.log(DOUBT) + row.log_doubt(self.posterior.expected_values)
            left_out = self.left_out + 1
            yield doubt, dataclasses.replace(self, posterior=before, left_out=left_out, age=age)

    def split(self) -> Iterator[Branch]:
        """Yield one branch for each effect that has probably changed, and one without them.

        As long as the sightings do not show which effects these are, only this branch is yielded.
        """
        posterior = self.posterior
        chance = posterior.probability.sum(axis=0)
        some = float(chance.sum())
        order = np.argsort(-chance)[:MOST]
        sure = some > CREDIBLE and posterior.chance_unexplained < NEGLIGIBLE + 0.5 * some
        count = posterior.count[int(posterior.probability[:, order[0]].argmax())] if sure else 0
        few = sure and chance[order].sum() >= (1.0 - DOUBT) * some and count >= _FEWEST
        if not (few or count >= _LATEST):
            yield self
            return
        likely = [c for c in order[: MOST - 1].tolist() if chance[c] > NEGLIGIBLE]
        past = {change.key for change in self.changes}
        for c in likely:
            key, changes = posterior.space.keys[c], self.changes
            if key not in past:
                t = int(posterior.probability[:, c].argmax())
                changes += (
                    _PastChange(
                        key=key,
                        where=posterior.space.where(c),
                        since_s=float(posterior.since[t]),
                        sightings=int(posterior.count[t]),
                        before=tuple(posterior.value_before(t, c).tolist()),
                    ),
                )
            yield dataclasses.replace(
                self,
                weight=self.weight * float(chance[c]),
                posterior=posterior.given_change(c),
                changes=changes,
            )
        rest = self.weight * (1.0 - float(chance[likely].sum()))
        if rest > NEGLIGIBLE:
            yield dataclasses.replace(
                self, weight=rest, posterior=posterior.without_changes(likely)
            )

    def merged_with(self, other: Branch) -> Branch:
        """Return this explanation with the weight and the moments of a less probable one too."""
        whole = self.weight + other.weight
        posterior = self.posterior.mixed_with(other.posterior, other.weight / whole)
        return dataclasses.replace(self, weight=whole, posterior=posterior)


@dataclass(frozen=True, eq=False)
class Explanations:
    """All explanations, with weights that sum to 1."""

    branches: tuple[Branch, ...]  # the most probable first
    visited: tuple[tuple[int, np.ndarray], ...] = ()
    """Number and joints of each pose whose own error is estimated, the last visited one last."""

    @property
    def left_out(self) -> int:
        """Number of sightings that the most probable explanation takes for wrong."""
        return self.branches[0].left_out

    @property
    def space(self) -> Parameters:
        """The parameters of the model and of all possible changes."""
        return self.branches[0].posterior.space

    def update(self, row: Row) -> Explanations:
        """Return the explanations and their weights after one more sighting."""
        visited = self.visited
        if row.pose is not None:
            place, is_new, visited = visit(visited, row.pose)
            row = dataclasses.replace(row, place=place, is_new=is_new)
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
        if len(made) > MOST:  # one branch for each set of changes
            merged: dict[tuple[frozenset[Key], int], Branch] = {}
            for b in sorted(made, key=lambda b: -b.weight):
                keys = frozenset(c.key for c in b.changes), b.left_out
                merged[keys] = merged[keys].merged_with(b) if keys in merged else b
            made = list(merged.values())
        kept = sorted(made, key=lambda b: -b.weight)[:MOST]
        whole = sum(b.weight for b in kept)
        branches = tuple(dataclasses.replace(b, weight=b.weight / whole) for b in kept)
        return Explanations(branches, visited)

    @cached_property
    def expected_values(self) -> np.ndarray:
        """The mean (q,) of the parameters over all explanations."""
        return np.sum([b.weight * b.posterior.expected_values for b in self.branches], axis=0)

    @cached_property
    def covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """The positions (p,) of the uncertain parameters, and their covariance (p, p)."""
        active = np.unique(np.concatenate([b.posterior.spread[0] for b in self.branches]))
        made = np.zeros((len(active), len(active)))
        for b in self.branches:
            places, covariance = b.posterior.spread
            own = np.isin(active, places)
            off = (b.posterior.expected_values - self.expected_values)[active]
            made += b.weight * np.outer(off, off)
            made[np.ix_(own, own)] += b.weight * covariance
        return active, made

    @cached_property
    def within_bounds(self) -> np.ndarray:
        """The most probable parameters within their bounds, (q,)."""
        return self.space.most_probable(self.expected_values, *self.covariance)

    def chance_of_knock(self, columns: np.ndarray, least: float) -> float:
        """Return the probability that base, tip or a measuring device was knocked out of place.

        Args:
            columns: (3, q) derivatives of a sighting by the parameters, m per unit.
            least: m; changes that an explanation already contains count as a knock if they shift
                this sighting by more than this.
        """
        made, space = 0.0, self.space
        for b in self.branches:
            off = np.zeros(len(space))
            for change in b.changes:
                if space.knocks[c := space.keys.index(change.key)]:
                    own = space.own(c)
                    off[own] = b.posterior.expected_values[own] - change.before
            gone = float(np.linalg.norm(columns @ off)) > least
            made += b.weight * (1.0 if gone else b.posterior.probability[:, space.knocks].sum())
        return made

    @property
    def is_disputed(self) -> bool:
        """True if the last sighting surprised and it is not yet clear whether it is wrong."""
        first = self.branches[0]
        other = sum(b.weight for b in self.branches if b.left_out != first.left_out)
        return first.age == 0 and other > NEGLIGIBLE

    @property
    def error_growth(self) -> float:
        """Factor by which the square of the errors that no parameter explains has grown."""
        return sum(b.weight * b.posterior.error_growth for b in self.branches)

    @property
    def chance_unexplained(self) -> float:
        """Probability that something changed that no known effect explains."""
        return sum(b.weight * b.posterior.chance_unexplained for b in self.branches)

    @cached_property
    def places(self) -> dict[str, float]:
        """The probability that something has changed, by place, in the order of the changes."""
        made = defaultdict[str, float](float)
        for b in self.branches:
            for place in dict.fromkeys(c.where for c in b.changes):
                made[place] += b.weight
        return dict(made)


class NamedChange(Declared):
    """A change: its place, and the most probable effect there.

    Attributes:
        since_s: time of the first sighting that shows it.
        by: (parameter, unit, change) of the parameters that changed. If several joints are
            concerned, the parameter's name begins with its joint.
        probability: probability of the effect, given that something changed there.
        rivals: other effects there that may have changed, with their probabilities.
        sightings: number of sightings that it took to find the change.
    """

    effect: str
    where: str
    since_s: float
    by: tuple[tuple[str, str, float], ...]
    probability: float
    rivals: tuple[tuple[str, float], ...]
    sightings: int

    @property
    def text(self) -> str:
        """The change in one line, such as ``backlash (61 %), joint 2: width +0.0031 rad``."""
        each = ((self.effect, self.probability), *self.rivals)
        names = " or ".join(f"{name} ({100 * p:.0f} %)" for name, p in each)
        by = ", ".join(f"{name} {value:+.2g} {unit}" for name, unit, value in self.by)
        return f"{names}, {self.where}: {by}"


def name_change(explanations: Explanations, where: str) -> NamedChange:
    """Describe the change at a place by the effect that has most probably changed there."""
    here = [(b, c) for b in explanations.branches for c in b.changes if c.where == where]
    whole = sum(b.weight for b, _ in here)
    chances = defaultdict[str, float](float)
    for branch, change in here:
        chances[change.key[0]] += branch.weight / whole
    first, *others = sorted(chances, key=lambda name: -chances[name])
    branch, change = next((b, c) for b, c in here if c.key[0] == first)
    space = branch.posterior.space
    places = space.own(space.keys.index(change.key))
    moved = branch.posterior.expected_values[places] - np.array(change.before)
    slots = [space.slots[k] for k in places]
    several = len({s.owner.where for s in slots}) > 1
    names = [f"{s.owner.where} " * several + s.parameter.name for s in slots]
    units = [s.parameter.unit for s in slots]
    by = tuple(each for each in zip(names, units, moved.tolist(), strict=True) if each[-1])
    return NamedChange(
        effect=first,
        where=where,
        since_s=change.since_s,
        by=by,
        probability=chances[first],
        rivals=tuple((name, chances[name]) for name in others),
        sightings=change.sightings,
    )
