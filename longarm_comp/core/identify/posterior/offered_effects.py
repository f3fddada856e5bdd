"""The offers at a fit: finds the best explanation by them, and the rivals of each effect in it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import expit, softmax

from longarm_comp.core.calibration.candidates import Candidate, Term, list_variants
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.identify.discover.inputs import count_levels
from longarm_comp.core.identify.model_tolerance import ModelTolerance
from longarm_comp.core.identify.posterior.ascent import as_certain, find_explanation
from longarm_comp.core.identify.posterior.found import (
    CREDIBLE,
    NONE,
    FoundEffect,
    PossibleCause,
    keys_of,
    smallest_set,
)
from longarm_comp.core.identify.posterior.offer import Offer, SingleEffect
from longarm_comp.core.identify.posterior.offer_bank import OfferBank
from longarm_comp.core.model.encoders import tell_apart
from longarm_comp.core.model.model import slots_of

LOOKED_AT = 1e-4
"""Probability above which another name is fitted in the place of an effect. Columns are linearised,
so a fit may raise the log evidence by ten."""
IMPOSSIBLE = 1e-20
"""Probability below which a name or a tolerance is dropped. A fit, or another explanation with that
tolerance, may raise the log evidence by forty (the touches of an iiwa 14 need more than thirty)."""


@dataclass(frozen=True)
class PosteriorResult:
    """The posterior over the offers of one bank: the best explanation, divided by probability.

    Attributes:
        found: its effects with a presence of at least 95 %.
        doubtful: its other effects.
        evidence: log evidence of the best explanation.
        effects: all of its single effects, as the search found them.
    """

    found: tuple[FoundEffect, ...]
    doubtful: tuple[FoundEffect, ...]
    evidence: float
    effects: tuple[SingleEffect, ...]


@dataclass(frozen=True, eq=False)
class OfferedEffects:
    """The offers at a fit, with the candidates that they stand for.

    Attributes:
        candidates: the candidates, in the order of the bank's offers.
        widths: (K,) units of the bank's columns.
        known: numbers of the offers that were found before.
        base: log evidence without any effect.
    """

    fitted: ModelFit
    candidates: Sequence[Candidate]
    bank: OfferBank
    widths: np.ndarray
    known: tuple[int, ...]
    base: float
    tolerance: ModelTolerance

    def find_best(self, begun: Sequence[SingleEffect] | None = None) -> PosteriorResult:
        """Find the explanation of highest evidence.

        Args:
            begun: the effects of an earlier explanation by the same offers, from which the search
                also starts.
        """
        best = find_explanation(self.bank, self.known, begun)
        offers = self._drop_idle_places(best.offers)
        evidence, values = self.bank.solve_together(offers)
        every = []
        for k, (effect, offer, value) in enumerate(zip(best.effects, offers, values, strict=True)):
            terms, factor = self._terms_of(effect.best, offer, value), self._bayes_factor(offers, k)
            every.append(FoundEffect.of(terms, effect.presence, factor, offer.log_prior))
        found = tuple(f for f in every if f.presence >= CREDIBLE)
        doubtful = tuple(f for f in every if f.presence < CREDIBLE)
        return PosteriorResult(found, doubtful, self.base + evidence, best.effects)

    def find_with_names(self) -> tuple[FoundEffect, ...]:
        """Return the effects of the best explanation, each with all names that it may have.

        This is faster than `find_best`: the search also starts from the known effects, but not
        again without each of them.
        """
        made = []
        best = find_explanation(self.bank, self.known, as_certain(self.bank, self.known))
        for effect in best.effects:
            shares: dict[str, tuple[float, Candidate]] = {}
            for n in np.flatnonzero(effect.probabilities > IMPOSSIBLE).tolist():
                terms = self.candidates[n].terms
                alike = [self._candidate_of_name(name, terms) for name in self._list_aliases(terms)]
                alike.insert(0, Candidate(terms[0].name, terms))
                for one in alike:
                    before, first = shares.get(one.name, (0.0, one))
                    share = float(effect.probabilities[n]) / effect.presence / len(alike)
                    shares[one.name] = before + share, first
            offer = effect.offer
            terms = self._terms_of(effect.best, offer, effect.mean[list(offer.column_numbers)])
            worth = math.log(effect.presence) - math.log1p(-min(effect.presence, 1.0 - 1e-16))
            share, _ = shares.pop(offer.name)
            mine = PossibleCause(Candidate(offer.name, terms), worth, share)
            rivals = (PossibleCause(one, worth, share) for share, one in shares.values())
            made.append(FoundEffect((mine, *rivals), effect.presence))
        return tuple(made)

    def evidence_of(self, explained: PosteriorResult) -> float:
        """Return the log evidence, at this tolerance, of an explanation found at another one."""
        offers = []
        for effect in explained.effects:
            whole, kept = self.bank.offers[effect.best], effect.offer.keys
            offers.append(whole.without([key for key in whole.keys if key not in kept]))
        return self.base + self.bank.evidence(offers)

    @cached_property
    def evidence_of_known(self) -> float:
        """Log evidence of the effects that were found before, in their present form."""
        return self.base + self.bank.evidence([self.bank.offers[n] for n in self.known])

    @cached_property
    def evidence_pruned(self) -> float:
        """Log evidence of the effects found before, less those that raise it too little.

        Their places that raise it too little are left out too.
        """
        offers = [self.bank.offers[n] for n in self.known]
        offers = [offers[k] for k in self.bank.worth_their_price(offers)]
        return self.base + max(map(self.bank.evidence, (offers, self._drop_idle_places(offers))))

    def judge_found(
        self, found: Sequence[FoundEffect], every: Sequence[OfferedEffects]
    ) -> tuple[tuple[FoundEffect, ...], tuple[FoundEffect, ...]]:
        """Judge the presence and the rivals of the effects in the model.

        Args:
            found: the effects in the model.
            every: the offers by every tolerance, this one included. An effect is compared with its
                absence at the best tolerance, because a larger error of another effect's form may
                explain as much.

        Returns:
            The effects with their credible sets, and doubtful effects that may be there besides.
        """
        offers = [self.bank.offers[n] for n in self.known]
        number = {list_variants(self.candidates[n].terms): k for k, n in enumerate(self.known)}
        fitted = {t.key: t for t in self.fitted.model.terms}
        made = []
        for f in found:
            k = number.get(list_variants(f.terms))
            if k is not None:
                rest = [*offers[:k], *offers[k + 1 :]]
                without = max(each.base + each.bank.evidence(rest) for each in every)
                presence = float(expit(self.evidence_of_known - without))
                f = dataclasses.replace(f, presence=presence)
                f = f.with_terms(fitted[t.key] for t in f.terms)
                made.append(self._add_rivals(f, offers, k))
        held = keys_of(found)
        besides = self.find_best(as_certain(self.bank, self.known)).doubtful
        left = (f for f in besides if held.isdisjoint(t.key for t in f.terms))
        return tuple(sorted(made, key=lambda f: -f.log_bayes_factor)), tuple(left)

    def _add_rivals(self, found: FoundEffect, offers: list[Offer], k: int) -> FoundEffect:
        """Return an effect with its rivals: all other names that may be true, at their best places.

        If no measurement distinguishes some names, the likeliest is judged and they share its
        probability.  The effect's own offer is number `k` of those of all known effects.
        """
        here, own = self.bank.evidence(offers), self._bayes_factor(offers, k)
        likeliest: dict[str, tuple[float, int, Offer, list[Offer]]] = {}
        otherwise: dict[object, tuple[Candidate, float]] = {}
        for n, offer, rest in self._list_substitutes(offers, k, here + math.log(LOOKED_AT)):
            tried = (offer, self._drop_idle_places_of([*rest, offer], len(rest)))
            worth = (self.bank.evidence_of_sets([[*rest, each] for each in tried]) - here).tolist()
            odds = max(worth)
            if offer.name == found.name:
                for each, value in zip(tried, worth, strict=True):
                    same = Candidate(offer.name, self._terms_of(n, each))
                    otherwise.setdefault(list_variants(same.terms), (same, value))
            elif odds > likeliest.get(offer.name, (-math.inf,))[0]:
                likeliest[offer.name] = odds, n, tried[int(np.argmax(worth))], rest
        first = [self._candidate_of_name(n, found.terms) for n in self._list_aliases(found.terms)]
        mine = [found.cause.candidate, *first]
        judged = [(0.0, own, offers[k].log_prior, mine)]
        names = {c.name for c in mine}
        for odds, n, offer, rest in sorted(likeliest.values(), key=lambda r: -r[0]):
            if offer.name in names:
                continue
            terms = self._terms_of(n, offer, self.bank.solve_together([*rest, offer])[1][-1])
            shared = [
                self._candidate_of_name(each, terms)
                for each in self._list_aliases(terms)
                if each not in names
            ]
            factor = own + odds - offer.log_prior + offers[k].log_prior
            alike = [Candidate(offer.name, terms), *shared]
            judged.append((odds, factor, offer.log_prior, alike))
            names |= {c.name for c in alike}
        chances = softmax([odds for odds, *_ in judged]).tolist()
        leader, *others = (
            PossibleCause(candidate, factor, chance / len(alike), alike[0].name, prior)
            for chance, (_, factor, prior, alike) in zip(chances, judged, strict=True)
            for candidate in alike
        )
        where = {tuple(t.where for t in found.terms): 1.0}
        for same, value in otherwise.values():
            where.setdefault(tuple(t.where for t in same.terms), math.exp(min(value, 0.0)))
        where = dict(sorted(where.items(), key=lambda w: -w[1]))
        otherwise.pop(list_variants(found.terms), None)
        found = dataclasses.replace(found, otherwise=tuple(otherwise.values()))
        found = found.put_first(dataclasses.replace(leader, loose=found.cause.loose), others)
        return dataclasses.replace(found, where=smallest_set(where))

    def _list_substitutes(
        self, offers: list[Offer], k: int, least: float
    ) -> Iterator[tuple[int, Offer, list[Offer]]]:
        """Yield the offers that may replace offer k, with a log evidence of at least about `least`.

        Each comes with its number and with the offers that stay beside it. If the replacement is a
        named effect of another name than offer k, other offers of its name are replaced too.
        """
        others = [*offers[:k], *offers[k + 1 :]]
        may, most = [], []
        for n, whole in enumerate(self.bank.offers):
            named = self.candidates[n].terms[0].searched and whole.name != offers[k].name
            rest = [o for o in others if not named or o.name != whole.name]
            offer = whole.free_part(frozenset(key for o in rest for key in o.keys))
            if offer is None:
                continue
            places = list(offer.column_numbers)
            paid = np.log1p(self.bank.gram[places, places] * max(offer.sizes) ** 2).sum() / 2
            if len(offer.keys) == 1 or offer.fixed:
                paid = 0.0
            may.append((n, offer, rest))
            most.append(paid)
        worth = self.bank.evidence_of_sets([[*rest, offer] for _, offer, rest in may]) + most
        yield from (may[k] for k in np.flatnonzero(worth >= least).tolist())

    def _bayes_factor(self, offers: list[Offer], k: int) -> float:
        """Return the log Bayes factor of offer k beside the others, its own prior taken out."""
        rest = [*offers[:k], *offers[k + 1 :]]
        odds = self.bank.evidence(offers) - self.bank.evidence(rest)
        return odds - offers[k].log_prior + NONE

    def _drop_idle_places(self, chosen: Sequence[Offer]) -> list[Offer]:
        """Return the offers, each without the places that contribute too little."""
        offers = list(chosen)
        for k in range(len(offers)):
            offers[k] = self._drop_idle_places_of(offers, k)
        return offers

    def _drop_idle_places_of(self, offers: list[Offer], k: int) -> Offer:
        """Return offer k without the places that contribute too little.

        A place must raise the log evidence by the log of the number of all places.  The log prior
        of the result includes the choice of its places.
        """
        offers, whole = list(offers), offers[k]
        price = math.log(max(len(offers[k].keys), 1))
        here = self.bank.evidence(offers) if len(offers[k].keys) > 1 else 0.0
        while len(offers[k].keys) > 1:
            less = (offers[k].without({key}) for key in offers[k].keys)
            fewer = [offer for offer in less if not self.bank.imitates_a_name(offer)]
            if not fewer:
                break
            tried = self.bank.evidence_of_sets([[*offers[:k], o, *offers[k + 1 :]] for o in fewer])
            least = int(np.argmax(tried))
            if here - tried[least] >= price:
                break
            offers[k], here = fewer[least], tried[least]
        choice = math.comb(len(whole.keys), len(offers[k].keys))
        return dataclasses.replace(offers[k], log_prior=whole.log_prior - math.log(choice))

    def _terms_of(
        self, number: int, offer: Offer, values: np.ndarray | None = None
    ) -> tuple[Term, ...]:
        """Return the terms of the offer of a number, or of what is left of it in `offer`.

        `values` are the coefficients of its columns; None: the terms keep their values.
        """
        held = {t.key: t for t in self.candidates[number].terms}
        if values is None:
            return tuple(held[key] for key in offer.keys)  # type: ignore[index]
        terms, start = [], 0
        for key, columns in zip(offer.keys, offer.columns, strict=True):
            term = held[key]  # type: ignore[index]
            amount = values[start : start + len(columns)] * self.widths[list(columns)]
            start += len(columns)
            slots = [] if offer.fixed else slots_of(self.fitted.model.arm, [term])
            names = [s.parameter.name for s in slots]
            terms.append(term.with_values(dict(zip(names, amount, strict=True))) if names else term)
        return tuple(terms)

    def _list_aliases(self, terms: Sequence[Term]) -> tuple[str, ...]:
        """Return the other names that no measurement distinguishes from that of some terms.

        If a joint stood at few positions, they include all free functions of it: each of them can
        take any values there.
        """
        name, commanded = terms[0].name, self.fitted.model.arm.commanded
        free_joints = {commanded.index(j) for t in terms if t.free_levels for j in t.joints}
        alike = set(self._aliases.get(name, ()))
        if free_joints:
            levels = max(count_levels(self.fitted.session.q[:, j]) for j in free_joints)
            first = ((n, self.candidates[k].terms[0]) for n, k in self._first_number.items())
            alike |= {n for n, term in first if term.free_levels >= levels}
        return tuple(sorted(alike - {name}))

    def _candidate_of_name(self, name: str, at: Sequence[Term]) -> Candidate:
        """Return the effect `name` at the places of some terms, in their forms.

        If it is not on offer at these places, its first candidate is returned.
        """
        there = self._first_term[name]
        if not all(t.where in there for t in at):
            return self.candidates[self._first_number[name]]
        terms = []
        for mine in at:
            term = there[mine.where]
            forms = {field: value for field, value in mine.forms.items() if field in term.forms}
            terms.append(dataclasses.replace(term, **forms))  # type: ignore[arg-type]
        return Candidate(name, tuple(terms))

    @cached_property
    def _first_term(self) -> dict[str, dict[str, Term]]:
        """The first term on offer, by name and place."""
        made: dict[str, dict[str, Term]] = {}
        for candidate in self.candidates:
            for term in candidate.terms:
                made.setdefault(candidate.name, {}).setdefault(term.where, term)
        return made

    @cached_property
    def _first_number(self) -> dict[str, int]:
        """The number of the first candidate of each name."""
        return {c.name: n for n, c in reversed(list(enumerate(self.candidates)))}

    @cached_property
    def _aliases(self) -> dict[str, set[str]]:
        """The other names on offer, by name, that mean the same physics as their effects declare.

        Names that readings of the joints tell apart are left out.
        """
        made: dict[str, set[str]] = {}
        arm = self.fitted.model.arm
        read = [arm.commanded[k] for k in self.fitted.session.read_joints]
        first = {name: self.candidates[n].terms[0] for name, n in self._first_number.items()}
        for name, term in first.items():
            for other in set(term.aliases) & set(first):
                if not tell_apart(arm, read, term, first[other]):
                    made.setdefault(name, set()).add(other)
                    made.setdefault(other, set()).add(name)
        return made
