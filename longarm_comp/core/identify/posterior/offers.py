"""What may explain a session, as one bank of offers: the library and functions without a name.

Every name is as likely as any other beforehand.  Its probability is divided among its places and
forms.  Functions without a name have a twentieth together.  Beside each effect in the model stands
what its form may leave: no effect's form is right to better than a tenth (`TOLERANCE`).
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TypeVar

import numpy as np

from longarm_comp.core.identify.aliasing import are_aliases
from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.discover.inputs import levels_of
from longarm_comp.core.identify.evidence import FitColumns, shift_of
from longarm_comp.core.identify.linear import Products
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.posterior.ascent import Explanation, explain
from longarm_comp.core.identify.posterior.found import (
    CREDIBLE,
    Explained,
    FoundEffect,
    Proposition,
)
from longarm_comp.core.identify.posterior.single_effects import (
    NONE,
    Offer,
    OfferBank,
    SingleEffect,
)
from longarm_comp.core.identify.structure import smooth_in
from longarm_comp.core.model.model import slots_of

TOLERANCE = 0.1
"""Share of its own shift by which an effect's form may err: play, friction and stiffness of real
joints differ so much from place to place along their way."""
UNNAMED = 0.05
"""Probability, beforehand, of a cause that the library does not hold."""
SIZES = (1.0, 4.0, 16.0)
"""Prior standard deviations of an effect, in its own prior's: few arms are so ill, but some are."""
CHANCES = tuple(math.log(p) for p in (0.6, 0.3, 0.1))
AMPLITUDES = (3.0, 30.0, 300.0)
"""Of a function without a name: prior standard deviations of its shift, in units of the noise."""


class OfferedEffects:
    """The bank of a fit.

    Args:
        things: candidates, in the order of the bank's offers.
        bank: the offers.
        bank: the offers.
        widths: (K,) units of the bank's columns.
        columns: of candidates at the fit's rows.
        known: number of effects that were found before.
    """

    def __init__(
        self,
        fitted: ModelFit,
        things: Sequence[Candidate],
        bank: OfferBank,
        widths: np.ndarray,
        columns: FitColumns,
        known: int = 0,
    ) -> None:
        self.known = known
        self.fitted, self.things, self.bank, self.widths = fitted, tuple(things), bank, widths
        self.columns = columns

    def explained(self, say: Callable[[str], None] = lambda _: None) -> Explained:
        """The posterior over the offers."""
        best = explain(self.bank, self.known)
        offers, effects = self._located(best)
        evidence, values = self.bank.joint(offers)
        every = [self._found(e, offers, k, values[k]) for k, e in enumerate(effects)]
        found = tuple(f for f in every if f.there >= CREDIBLE)
        for f in found:
            say(Candidate(f.name, f.terms).label)
        return Explained(found, tuple(f for f in every if f.there < CREDIBLE), evidence)

    def standing(self, found: Sequence[FoundEffect]) -> float:
        """Log evidence of what was found before, as it is in the model."""
        at = {tuple(t.variant for t in c.terms): n for n, c in enumerate(self.things)}
        known = (at.get(tuple(t.variant for t in f.terms)) for f in found)
        return self.bank.evidence([self.bank.offers[n] for n in known if n is not None])

    def judged(
        self, found: Sequence[FoundEffect]
    ) -> tuple[tuple[FoundEffect, ...], tuple[FoundEffect, ...]]:
        """What was found and is in the model, with its probabilities by this bank; the doubtful."""
        explained = self.explained()
        again = {frozenset(t.key for t in f.terms): f for f in explained.found}
        fitted = {t.key: t for t in self.fitted.model.terms}
        made = []
        for f in found:
            now = again.get(frozenset(t.key for t in f.terms), f)
            made.append(dataclasses.replace(now, terms=tuple(fitted[t.key] for t in f.terms)))
        held = {t.key for f in found for t in f.terms}
        doubtful = (*explained.doubtful, *(f for f in explained.found if f.name not in
                    {g.name for g in found}))  # fmt: skip
        left = tuple(f for f in doubtful if held.isdisjoint(t.key for t in f.terms))
        return tuple(sorted(made, key=lambda f: -f.log_bayes_factor)), left

    def _located(self, best: Explanation) -> tuple[list[Offer], tuple[SingleEffect, ...]]:
        """The best offers without the places that bring nothing.

        One place more costs as much as the choice among as many places.
        """
        offers = list(best.chosen)
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
        return offers, best.effects

    def _found(
        self, effect: SingleEffect, offers: list[Offer], k: int, values: np.ndarray
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
        for number in np.flatnonzero(effect.q > 1e-6).tolist():
            thing, chance = self.things[number], float(effect.q[number]) / there
            names_[thing.name] = names_.get(thing.name, 0.0) + chance
            if effect.q[number] >= effect.q[best_of.setdefault(thing.name, number)]:
                best_of[thing.name] = number
            if thing.name == terms[0].name:
                places[thing.where] = places.get(thing.where, 0.0) + chance
        shared = self._shared(names_, terms)
        own = self.bank.evidence(offers) - self.bank.evidence([*offers[:k], *offers[k + 1 :]])
        own -= offer.log_prior - NONE
        rivals = []
        for name, chance in _falling(shared):
            if name == terms[0].name or chance < 0.01:
                continue
            number = best_of.get(name, self._first[name])
            log_odds = math.log(max(effect.q[number], 1e-300) / max(effect.q[effect.best], 1e-300))
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
            few = free - {name} if levels and name in free else set()
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
        """Names on offer that are the same physics, as their effects declare it."""
        made: dict[str, set[str]] = {}
        for name, number in self._first.items():
            term = self.things[number].terms[0]
            alike = (n for n in set(term.aliases) & set(self._first) if are_aliases(
                self.fitted, term, self.things[self._first[n]].terms[0]))  # fmt: skip
            for other in alike:
                made.setdefault(name, set()).add(other)
                made.setdefault(other, set()).add(name)
        return made


def offered(
    fitted: ModelFit,
    columns: FitColumns,
    library: Sequence[Candidate],
    functions: Sequence[Proposition],
    found: Sequence[FoundEffect],
) -> OfferedEffects:
    """The bank at a fit.

    Args:
        fitted: geometry and what was found so far.
        columns: of candidates at its rows.
        library: the named effects.
        functions: without a name.
        found: what was found so far; it stays on offer in its present form.
    """
    arm = fitted.model.arm
    names = {c.name for c in library}
    forms = Counter(c.name for c in library)
    share = math.log((1.0 - UNNAMED) / max(len(names), 1))
    listed: list[tuple[Candidate, float, tuple[float, ...], tuple[float, ...]]] = []
    for candidate in library:
        price = sum(t.price(arm) for t in candidate.terms)
        prior = share - math.log(forms[candidate.name]) - price
        listed.append((candidate, prior, SIZES, CHANCES))
    even = (-math.log(len(AMPLITUDES)),) * len(AMPLITUDES)
    for function in functions:
        thing = Candidate(function.terms[0].name, function.terms)
        listed.append((thing, math.log(UNNAMED) + function.log_prior, AMPLITUDES, even))
    offered_now = {tuple(t.variant for t in c.terms) for c, _, _, _ in listed}
    for f in found:
        if tuple(t.variant for t in f.terms) in offered_now:
            continue
        prior = share - math.log(forms[f.name]) if f.name in names else math.log(UNNAMED)
        thing = Candidate(f.name, f.terms)
        listed.append((thing, prior, SIZES, CHANCES))
    terms = list({t.variant: t for c, _, _, _ in listed for t in c.terms}.values())
    held = {t.key for f in found for t in f.terms}
    beside = tolerances(fitted, columns, found)
    marginal = columns.without(held, beside)
    products, where, lower, upper, widths = _columns(fitted, columns, terms)
    (gram, along), *_ = marginal.of([products])
    offers, things = [], []
    for candidate, prior, sizes, chances in listed:
        own = tuple(where[t.variant] for t in candidate.terms)
        flat = [k for part in own for k in part]
        if (
            not flat
            or not np.isfinite(gram[np.ix_(flat, flat)]).all()
            or not gram[flat, flat].any()
        ):
            continue
        fixed = not candidate.slots(arm)
        keys = tuple(t.key for t in candidate.terms)
        if fixed:
            sizes, chances = (1.0,), (0.0,)
        offers.append(Offer(candidate.name, keys, own, prior, sizes, chances, fixed))
        things.append(candidate)
    return OfferedEffects(
        fitted, things, OfferBank(offers, gram, along, lower, upper), widths, columns, len(found)
    )


def tolerances(
    fitted: ModelFit, columns: FitColumns, found: Sequence[FoundEffect]
) -> np.ndarray | None:
    """(m, k) whitened: by how much the shift of each effect in the model may differ from its form.

    It varies with every joint, smoothly.
    """
    if not found:
        return None
    session = fitted.session
    ways = np.concatenate([smooth_in(q)[:, :2] for q in session.q.T], axis=1)
    ways = ways * (TOLERANCE / math.sqrt(max(ways.shape[1], 1)))
    made = []
    held = {t.key: t for t in fitted.model.terms}
    for f in found:
        terms = [held[t.key] for t in f.terms if t.key in held]
        if terms:
            shift = shift_of(fitted, columns, terms)
            made.append(shift[:, :, None] * ways[:, None, :])
    return fitted.whitened(np.concatenate(made, axis=-1)) if made else None


def _columns(
    fitted: ModelFit, columns: FitColumns, terms: Sequence[Term]
) -> tuple[Products, dict, np.ndarray, np.ndarray, np.ndarray]:
    """Columns of all terms side by side, with their bounds and units."""
    arm = fitted.model.arm
    free = [t for t in terms if slots_of(arm, [t])]
    whole = [t for t in terms if not slots_of(arm, [t])]
    scaled = columns.scaled(free)
    parts, crosses = [scaled.b], [scaled.cross]
    where: dict[tuple[object, ...], tuple[int, ...]] = {}
    start = 0
    for term in free:
        count = len(slots_of(arm, [term]))
        where[term.variant] = tuple(range(start, start + count))
        start += count
    lower, upper, widths = [scaled.lower], [scaled.upper], [scaled.widths]
    for term in whole:
        white = fitted.whitened(columns.shift([term])[..., None])
        parts.append(white)
        crosses.append(fitted.design.T @ white)
        where[term.variant] = (start,)
        start += 1
        lower.append(np.full(1, -np.inf))
        upper.append(np.full(1, np.inf))
        widths.append(np.ones(1))
    b = np.concatenate(parts, axis=1)
    return (
        Products(b, b.T @ b, np.concatenate(crosses, axis=1)),
        where,
        np.concatenate(lower),
        np.concatenate(upper),
        np.concatenate(widths),
    )


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
