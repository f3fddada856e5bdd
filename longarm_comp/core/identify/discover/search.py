"""The search for effects without a name, on top of everything that has one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from longarm_comp.core.errors import JobError
from longarm_comp.core.identify.discover.bank import (
    Bank,
    Hypothesis,
    Weighed,
    around,
    marginal_of,
)
from longarm_comp.core.identify.discover.banks import banks
from longarm_comp.core.identify.discover.screening import Screening
from longarm_comp.core.identify.discover.set_aside import (
    given_back,
    shared,
    switches,
)
from longarm_comp.core.identify.discover.terms import (
    key_of,
    part,
    refitted,
    same,
    terms_of,
    with_terms,
)
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import NoiseEstimate

ENOUGH = 2.5
"""Log evidence, the choice paid for, from which on a term is added."""
SHARP = 3.0
"""A threshold must be this much better than the best function without one."""
SWAP = 2.0
"""A term must be this much better than the one whose place it takes."""
MOST = 6
"""Terms at most."""
ROUNDS = 3
"""Of growing, then swapping and joining, at most."""
SCREENED = 12
"""Candidates of a bank that are scored exactly."""
DENSE = 8
"""Of these, how many are refined."""
NEARBY = (1.0, 0.08)
"""Reach of the looks around a threshold or frequency, in steps between those tried."""
LOOKS = math.log(4.0)
"""Paid for them, log odds."""
BACK = 0.75
"""Share of a group of rows set aside that a switch must bring back."""


@dataclass(frozen=True)
class SearchedFunctions:
    """What was found.

    Attributes:
        fit: of the model with the terms.
        groups: what was added, in the order of finding, with its evidence on top of the rest.
        noise: as judged with the terms.
        alternatives: by group, others that explain as much but for the odds of `PLACES`.
        back: (N,) rows that were set aside and that a switch brought back.
        back_evidence: log odds of the switches against as many outliers, in just these rows.
    """

    fit: ModelFit
    groups: tuple[Weighed, ...]
    noise: NoiseEstimate
    alternatives: tuple[tuple[Weighed, ...], ...]
    back: np.ndarray
    back_evidence: float = 0.0


PLACES = 3.0
"""Log odds below which another place explains a term as well."""


def search(
    base: ModelFit,
    known: NoiseEstimate | None,
    say: Callable[[str], None] = lambda _: None,
    promising: Callable[[ModelFit], bool] = lambda _: True,
) -> SearchedFunctions | None:
    """Terms that explain what a fit leaves; None where nothing does.

    Args:
        base: fit of everything that has a name.
        known: noise from repeats, where there is any.
        say: told what is being looked at.
        promising: asked about the fit when no further term pays; where it is not, nothing is
            improved and nothing returned.
    """
    state = _State(base, known)
    for _ in range(ROUNDS):
        grown = state.grow(say)
        while state.give_back(say):
            grown = state.grow(say) or True
        if not promising(state.fit):
            return None
        if not grown or not (state.swap(say) | state.join(say)):
            break
    if not state.groups:
        return None
    groups = tuple(state.evidence(k) for k in range(len(state.groups)))
    others = tuple(state.others(k, groups[k]) for k in range(len(groups)))
    return state.found(groups, others)


def first(
    base: ModelFit, known: NoiseEstimate | None, say: Callable[[str], None] = lambda _: None
) -> SearchedFunctions | None:
    """The term that explains most of what a fit leaves, fitted; None where none pays.

    Args as `search`, of which it is the first step.
    """
    state = _State(base, known)
    best = state.best()
    if best is None or best.log_evidence < ENOUGH:
        return None
    say(_label(best.candidate))
    if not state.take((best,)):
        return None
    return state.found(state.groups, ((),) * len(state.groups))


class _State:
    def __init__(self, base: ModelFit, known: NoiseEstimate | None) -> None:
        self.base, self.known = base, known
        self.groups: tuple[Weighed, ...] = ()
        self.fit, self.noise = refitted(base.model, base, known)
        self.banks = banks(self.fit)
        self.back, self.back_evidence = np.zeros(len(self.fit.weights), bool), 0.0
        self._screened_for: ModelFit | None = None
        self._screened: tuple[Screening, ...] = ()

    def found(
        self, groups: tuple[Weighed, ...], others: tuple[tuple[Weighed, ...], ...]
    ) -> SearchedFunctions:
        """The outcome."""
        back = self.back & (self.fit.weights > 0)
        paid = self.back_evidence if back.any() else 0.0
        return SearchedFunctions(self.fit, groups, self.noise, others, back, paid)

    # ------------------------------------------------------------------ scoring

    def best(self, without: Sequence[int] = ()) -> Weighed | None:
        """The best candidate on top of the model without some groups."""
        found = self.ranked(without)
        sharp = [s for s in found if s.candidate.family.sharp]
        smooth = [s for s in found if not s.candidate.family.sharp]
        if not smooth or (sharp and sharp[0].log_evidence > smooth[0].log_evidence + SHARP):
            return sharp[0] if sharp else None
        return smooth[0]

    def ranked(self, without: Sequence[int] = ()) -> list[Weighed]:
        """Candidates of all banks, best first, thresholds and frequencies refined."""
        kept = self._kept(without)
        marginal, py = marginal_of(self.fit, kept)
        made: list[Weighed] = []
        for bank, screening in zip(self.banks, self._screenings(), strict=True):
            few = screening.best(kept, py, SCREENED)
            mine = [bank.score(marginal, self.fit, c) for c in few if not self._held(c, without)]
            mine.sort(key=lambda s: -s.log_evidence)
            for one in mine[:DENSE]:
                mine += self._refined(bank, marginal, one)
            made += mine
        return sorted(made, key=lambda s: -s.log_evidence)

    def _screenings(self) -> tuple[Screening, ...]:
        """One of every bank for the fit as it is now."""
        if self._screened_for is not self.fit:
            self._screened_for = self.fit
            self._screened = tuple(Screening(bank, self.fit) for bank in self.banks)
        return self._screened

    def _refined(self, bank: Bank, marginal: Marginal, one: Weighed) -> list[Weighed]:
        """A candidate with other thresholds or frequencies, closer and closer to the best."""
        made: list[Weighed] = []
        prior = one.candidate.log_prior - LOOKS
        for width in NEARBY:
            few = (
                dataclasses.replace(c, log_prior=prior) for c in around(bank, one.candidate, width)
            )
            made += [bank.score(marginal, self.fit, c) for c in few]
            one = max((one, *made), key=lambda s: s.log_evidence)
        return made

    def _held(self, candidate: Hypothesis, without: Sequence[int]) -> bool:
        held = {
            m for k, g in enumerate(self.groups) if k not in without for m in g.candidate.members
        }
        return bool(held & set(candidate.members))

    def _kept(self, without: Sequence[int]) -> np.ndarray:
        gone = {key_of(t) for k in without for t in terms_of(self.groups[k])}
        return np.array([key_of(s.owner) not in gone for s in self.fit.slots])

    def evidence(self, k: int) -> Weighed:
        """A group on top of all others."""
        marginal, _ = marginal_of(self.fit, self._kept([k]))
        return self._score(marginal, self.groups[k].candidate)

    def _score(self, marginal: Marginal, candidate: Hypothesis) -> Weighed:
        for bank in self.banks:
            if candidate.members[0][0] in bank.places:
                return bank.score(marginal, self.fit, candidate)
        raise AssertionError(candidate)

    def others(self, k: int, now: Weighed) -> tuple[Weighed, ...]:
        """Other places (and components) of the same functions that do nearly as well."""
        marginal, _ = marginal_of(self.fit, self._kept([k]))
        members = now.candidate.members
        if len({p for p, _ in members}) > 1:
            return ()
        made = []
        for bank in self.banks:
            for place in bank.places:
                if place != members[0][0] and members[0][0] in bank.places:
                    moved = tuple((place, f) for _, f in members)
                    other = bank.score(
                        marginal, self.fit, dataclasses.replace(now.candidate, members=moved)
                    )
                    if other.log_evidence > now.log_evidence - PLACES:
                        made.append(other)
        return tuple(sorted(made, key=lambda s: -s.log_evidence))

    # ------------------------------------------------------------------ steps

    def grow(self, say: Callable[[str], None]) -> bool:
        """Add groups until none pays; whether any was added."""
        grown = False
        while len(self.groups) < MOST:
            best = self.best()
            if best is None or best.log_evidence < ENOUGH:
                break
            say(_label(best.candidate))
            before = self.groups
            if not self.take((*before, best)) or len(self.groups) <= len(before):
                break
            grown = True
        return grown

    def give_back(self, say: Callable[[str], None]) -> bool:
        """Add a switch that explains rows set aside as a group; whether there is one."""
        group = shared(self.fit, ((bank.places, bank.units) for bank in self.banks))
        if group is None or len(self.groups) >= MOST:
            return False
        before = self.groups, self.fit, self.noise
        self.fit = given_back(self.fit, group.rows)
        marginal, _ = marginal_of(self.fit, self._kept(()))
        tried = [
            bank.score(marginal, self.fit, c)
            for bank in self.banks
            for c in switches(bank, self.fit, group.rows)
            if not self._held(c, ())
        ]
        best = max(tried, key=lambda s: s.log_evidence, default=None)
        if best is not None and best.log_evidence >= ENOUGH:
            say(f"{_label(best.candidate)}: {group.rows.sum()} rows that were set aside")
            if self.take((*before[0], best)):
                inside = self.fit.weights > 0
                if inside.sum() - (before[1].weights > 0).sum() >= BACK * group.rows.sum():
                    self.back |= group.rows
                    self.back_evidence += group.log_evidence + group.log_choices
                    return True
        self.groups, self.fit, self.noise = before
        return False

    def take(self, groups: Sequence[Weighed]) -> bool:
        """Fit with some groups, judge the noise again, drop what no longer pays.

        Whether the fit stayed finite; else nothing is changed.
        """
        before = self.groups, self.fit, self.noise
        while True:
            self.groups = tuple(groups)
            model = with_terms(self.base.model, self.fit.model, self.groups)
            try:
                self.fit, self.noise = refitted(model, self.fit, self.known)
            except JobError:
                self.groups, self.fit, self.noise = before
                return False
            groups = self._lasting()
            if same(groups, self.groups):
                return True

    def _lasting(self) -> tuple[Weighed, ...]:
        """The groups without members that are less than their own uncertainty, and without
        the weakest group that does not pay."""
        values = {
            key_of(s.owner): (getattr(s.owner, s.parameter.name), se)
            for s, se in zip(self.fit.slots, self.fit.standard_errors, strict=True)
        }
        made, weakest, low = [], None, ENOUGH
        for k, group in enumerate(self.groups):
            sure = [
                i
                for i, t in enumerate(terms_of(group))
                if abs(values[key_of(t)][0]) > values[key_of(t)][1]
            ]
            if not sure:
                continue
            made.append(part(group, sure))
            evidence = self.evidence(k).log_evidence
            if evidence < low:
                weakest, low = made[-1], evidence
        return tuple(g for g in made if g is not weakest)

    def swap(self, say: Callable[[str], None]) -> bool:
        """Replace groups by better ones, given the rest."""
        changed = False
        for k in range(len(self.groups)):
            if k >= len(self.groups):
                break
            now, best = self.evidence(k), self.best([k])
            if best is not None and best.log_evidence > now.log_evidence + SWAP:
                say(f"{_label(best.candidate)} instead")
                changed |= self.take((*self.groups[:k], best, *self.groups[k + 1 :]))
        return changed

    def join(self, say: Callable[[str], None]) -> bool:
        """One group in the place of two, where it is better than both."""
        for i, j in combinations(range(len(self.groups)), 2):
            best = self.best([i, j])
            marginal, _ = marginal_of(self.fit, self._kept([i, j]))
            first = self._score(marginal, self.groups[i].candidate)
            now = first.log_evidence + self.evidence(j).log_evidence
            if best is not None and best.log_evidence > now + SWAP:
                say(f"{_label(best.candidate)} instead of two")
                kept = [g for k, g in enumerate(self.groups) if k not in (i, j)]
                if self.take((*kept, best)):
                    return True
        return False


def _label(candidate: Hypothesis) -> str:
    place, function = candidate.members[0]
    return f"{place.at}, {place.component}: {function.formula}"
