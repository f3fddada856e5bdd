"""The bank of a fit: what it says of the effects that are there, and of what may stand instead."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.special import expit

from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.discover.inputs import levels_of
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.posterior.ascent import Explanation, explain
from longarm_comp.core.identify.posterior.found import (
    CREDIBLE,
    Explained,
    FoundEffect,
)
from longarm_comp.core.identify.posterior.single_effects import (
    NONE,
    Offer,
    OfferBank,
    SingleEffect,
)
from longarm_comp.core.model.encoders import tell_apart
from longarm_comp.core.model.model import slots_of

LOOKED_AT = 1e-4
"""Probability from which on another name is fitted in the place of an effect: with one size for all
of an offer's coefficients it may be as much too low."""


@dataclass(frozen=True, eq=False)
class OfferedEffects:
    """The bank of a fit.

    Attributes:
        things: candidates, in the order of the bank's offers.
        bank: the offers.
        widths: (K,) units of the bank's columns.
        known: offers that were found before.
        base: log evidence of nothing.
        tolerance: share of its own shift by which the form of what is in the model may err.
    """

    fitted: ModelFit
    things: Sequence[Candidate]
    bank: OfferBank
    widths: np.ndarray
    known: tuple[int, ...] = ()
    base: float = 0.0
    tolerance: float = 0.0

    def explained(self) -> Explained:
        """The posterior over the offers."""
        best = explain(self.bank, self.known)
        offers, effects = self._located(best.chosen), best.effects
        instead = self._instead(best)
        evidence, values = self.bank.joint(offers)
        every = [self._found(e, offers, k, values[k], instead[k]) for k, e in enumerate(effects)]
        found = tuple(f for f in every if f.there >= CREDIBLE)
        return Explained(found, tuple(f for f in every if f.there < CREDIBLE), self.base + evidence)

    @cached_property
    def standing(self) -> float:
        """Log evidence of what was found before, as it is in the model."""
        return self.base + self.bank.evidence([self.bank.offers[n] for n in self.known])

    @cached_property
    def pruned(self) -> float:
        """The same without effects and places that are not worth their price beside the rest."""
        offers = [self.bank.offers[n] for n in self.known]
        best = self.bank.evidence(offers)
        while offers:
            fewer = [[o for o in offers if o is not gone] for gone in offers]
            worth = [self.bank.evidence(some) for some in fewer]
            if max(worth) <= best:
                break
            best, offers = max(worth), fewer[int(np.argmax(worth))]
        return self.base + max(best, self.bank.evidence(self._located(offers)))

    def judged(
        self, found: Sequence[FoundEffect]
    ) -> tuple[tuple[FoundEffect, ...], tuple[FoundEffect, ...]]:
        """What was found and is in the model, with its probabilities by this bank; the doubtful."""
        explained = self.explained()
        again = {frozenset(t.key for t in f.terms): f for f in explained.found}
        fitted = {t.key: t for t in self.fitted.model.terms}
        made = []
        offers = [self.bank.offers[n] for n in self.known]
        for f in found:
            now = again.get(frozenset(t.key for t in f.terms), f)
            if now is f:  # not found again: by what it is worth beside the others
                rest = [o for o in offers if set(o.keys).isdisjoint(t.key for t in f.terms)]
                worth = self.bank.evidence(offers) - self.bank.evidence(rest)
                now = dataclasses.replace(f, there=float(expit(worth)), log_bayes_factor=worth)
            made.append(dataclasses.replace(now, terms=tuple(fitted[t.key] for t in f.terms)))
        held = {t.key for f in found for t in f.terms}
        doubtful = (*explained.doubtful, *(f for f in explained.found if f.name not in
                    {g.name for g in found}))  # fmt: skip
        left = tuple(f for f in doubtful if held.isdisjoint(t.key for t in f.terms))
        return tuple(sorted(made, key=lambda f: -f.log_bayes_factor)), left

    def _instead(self, best: Explanation) -> list[dict[int, float]]:
        """For each effect the offers that stand in its place in other explanations.

        With the probability of these explanations beside the best.
        """
        made: list[dict[int, float]] = [{} for _ in best.effects]
        seen: dict[frozenset[str], Explanation] = {}
        for other in sorted(best.others, key=lambda e: e.evidence):
            seen[frozenset(o.name for o in other.chosen)] = other
        mine = frozenset(o.name for o in best.chosen)
        rest = {names: e for names, e in seen.items() if names - mine}
        chances = np.exp([min(e.evidence - best.evidence, 0.0) for e in rest.values()])
        chances /= 1.0 + chances.sum()
        for (names, other), chance in zip(rest.items(), chances.tolist(), strict=True):
            new = [e.best for e in other.effects if self.things[e.best].name not in mine]
            for effects, offer in zip(made, best.chosen, strict=True):
                if offer.name not in names:
                    for n in new:
                        effects[n] = effects.get(n, 0.0) + chance / len(new)
        return made

    def _located(self, chosen: Sequence[Offer]) -> list[Offer]:
        """The best offers without the places that bring nothing.

        One place more costs as much as the choice among as many places.
        """
        offers = list(chosen)
        for k, offer in enumerate(offers):
            price = math.log(max(len(offer.keys), 1))
            while len(offers[k].keys) > 1:
                here = self.bank.evidence(offers)
                fewer = [_less(offers[k], key) for key in offers[k].keys]
                tried = [self.bank.evidence([*offers[:k], o, *offers[k + 1 :]]) for o in fewer]
                least = int(np.argmax(tried))
                if here - tried[least] >= price:
                    break
                offers[k] = fewer[least]
        return offers

    def _found(
        self,
        effect: SingleEffect,
        offers: list[Offer],
        k: int,
        values: np.ndarray,
        instead: Mapping[int, float],
    ) -> FoundEffect:
        offer = offers[k]
        held = {t.key: t for t in self.things[effect.best].terms}
        terms, start = [], 0
        for key, columns in zip(offer.keys, offer.columns, strict=True):
            term = held[key]  # type: ignore[index]
            amount = values[start : start + len(columns)] * self.widths[list(columns)]
            start += len(columns)
            slots = [] if offer.fixed else slots_of(self.fitted.model.arm, [term])
            names = [s.parameter.name for s in slots]
            terms.append(term.with_values(dict(zip(names, amount, strict=True))) if names else term)
        there = max(effect.there, 1e-300)
        names_: dict[str, float] = {}
        places: dict[tuple[str, ...], float] = {}
        best_of: dict[str, int] = {}
        q = effect.q * (1.0 - sum(instead.values())) / there
        for number, chance in instead.items():
            q[number] += chance
        for number in np.flatnonzero(q > 1e-6).tolist():
            thing, chance = self.things[number], float(q[number])
            names_[thing.name] = names_.get(thing.name, 0.0) + chance
            if q[number] >= q[best_of.setdefault(thing.name, number)]:
                best_of[thing.name] = number
            if thing.name == terms[0].name:
                places[thing.where] = places.get(thing.where, 0.0) + chance
        shared = self._shared(names_, terms)
        own = self.bank.evidence(offers) - self.bank.evidence([*offers[:k], *offers[k + 1 :]])
        own -= offer.log_prior - NONE
        rivals = []
        for name, chance in _falling(shared):
            if name == terms[0].name or chance < LOOKED_AT:
                continue
            number = best_of.get(name, self._first[name])
            log_odds = math.log(max(q[number], 1e-300) / max(q[effect.best], 1e-300))
            prior = self.bank.offers[number].log_prior - self.bank.offers[effect.best].log_prior
            alike = 0.0 if name not in best_of else log_odds - prior
            rivals.append((self.things[number], own + alike))
        return FoundEffect(
            tuple(terms),
            effect.there,
            tuple(sorted(shared.items(), key=lambda c: (c[0] != terms[0].name, -c[1]))),
            _falling(places),
            own,
            tuple(rivals),
        )

    def _shared(self, names: Mapping[str, float], terms: Sequence[Term]) -> dict[str, float]:
        """Probabilities of names; those that no measurement distinguishes share theirs evenly.

        So do functions of a joint that stood at few positions: each can take any values there.
        """
        made: dict[str, float] = {}
        levels = max((self._levels(t) for t in terms), default=0)
        free = {n for n, k in self._first.items() if self.things[k].terms[0].free_levels >= levels}
        for name, chance in names.items():
            few = free - {name} if levels and name == terms[0].name else set()
            alike = [name, *self._aliases.get(name, set()) | few]
            for other in alike:
                made[other] = made.get(other, 0.0) + chance / len(alike)
        return made

    def _levels(self, term: Term) -> int:
        """At how many positions the joint stood that a function of joints is at; 0 for others."""
        if not term.free_levels:
            return 0
        commanded = self.fitted.model.arm.commanded
        stood = [self.fitted.session.q[:, commanded.index(j)] for j in term.joints]
        return max((levels_of(q) for q in stood), default=0)

    @cached_property
    def _first(self) -> dict[str, int]:
        """The first offer of every name."""
        return {c.name: n for n, c in reversed(list(enumerate(self.things)))}

    @cached_property
    def _aliases(self) -> dict[str, set[str]]:
        """Names on offer that are the same physics, as their effects declare it.

        But for those that readings of joints tell apart.
        """
        made: dict[str, set[str]] = {}
        arm = self.fitted.model.arm
        read = [arm.commanded[k] for k in self.fitted.session.read_joints]
        for name, number in self._first.items():
            term = self.things[number].terms[0]
            for other in set(term.aliases) & set(self._first):
                if not tell_apart(arm, read, term, self.things[self._first[other]].terms[0]):
                    made.setdefault(name, set()).add(other)
                    made.setdefault(other, set()).add(name)
        return made


K = TypeVar("K")


def _falling(chances: Mapping[K, float]) -> tuple[tuple[K, float], ...]:
    """The most probable first."""
    return tuple(sorted(chances.items(), key=lambda c: -c[1]))


def _less(offer: Offer, key: object) -> Offer:
    left = [(k, c) for k, c in zip(offer.keys, offer.columns, strict=True) if k != key]
    keys, columns = zip(*left, strict=True)
    return Offer(
        offer.name, keys, columns, offer.log_prior, offer.sizes, offer.chances, offer.fixed
    )
