"""The best explanation by single effects: coordinate ascent, with restarts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.calibration.linear import BETTER
from longarm_comp.core.identify.posterior.offer import (
    ROUNDS,
    UNLIKELY,
    Offer,
    OtherEffects,
    SingleEffect,
)
from longarm_comp.core.identify.posterior.offer_bank import OfferBank

AT_ONCE = 3
"""Largest number of single effects that one call adds. The forms of large effects must be fitted
before smaller effects can be told from them."""


@dataclass(frozen=True)
class Explanation:
    """Several single effects together.

    Attributes:
        bank: the offers among which they were chosen.
        effects: the effects, in the order in which they were found.
    """

    bank: OfferBank
    effects: tuple[SingleEffect, ...]

    @cached_property
    def offers(self) -> tuple[Offer, ...]:
        """The most probable offer of each effect."""
        return tuple(e.offer for e in self.effects)

    @cached_property
    def evidence(self) -> float:
        """Log evidence of the chosen offers together, their priors included."""
        return self.bank.evidence(self.offers)


def find_explanation(
    bank: OfferBank, known: Sequence[int] = (), begun: Sequence[SingleEffect] | None = None
) -> Explanation:
    """Find the best explanation by coordinate ascent, with a restart for each effect found.

    The ascent only finds the nearest maximum.  So it starts without effects, and again from the
    known ones. Then the name of each effect found is excluded once: effects of other names, which
    may be several, are sought in its place, and the name is admitted again. Of all these
    explanations that of highest evidence is kept.  If only the single offer were excluded, the same
    name would return at other places, and two effects could never replace one.

    Args:
        known: numbers of the offers that were found before.
        begun: the effects of an earlier explanation by the same offers. If given, the ascent also
            starts from these instead of `known`, and there is no restart.

    Returns:
        The explanation of highest evidence, without effects that do not raise it.
    """
    most = len(known) + AT_ONCE
    starts = [_add_effects(bank, (), frozenset(), most)]
    if begun or known:
        starts.append(_add_effects(bank, begun or as_certain(bank, known), frozenset(), most))
    best = max(map(_drop_superfluous, starts), key=lambda e: e.evidence)
    if begun is not None:
        return best
    tried_without: set[str] = set()
    while left := [e for e in best.effects if e.offer.name not in tried_without]:
        effect = left[0]
        tried_without.add(effect.offer.name)
        names = {bank.offers[n].name for n in np.flatnonzero(effect.probabilities > UNLIKELY)}
        excluded = frozenset(n for n, offer in enumerate(bank.offers) if offer.name in names)
        others = tuple(e for e in best.effects if e is not effect)
        without = _add_effects(bank, others, excluded, min(len(others) + AT_ONCE, most))
        again = _add_effects(bank, without.effects, frozenset(), most)
        again = max(map(_drop_superfluous, (without, again)), key=lambda e: e.evidence)
        if again.evidence > best.evidence + BETTER:
            best = again
    return best


def as_certain(bank: OfferBank, known: Sequence[int]) -> list[SingleEffect]:
    """Return one certain effect for each of the known offers, which are solved together."""
    offers = [bank.offers[n] for n in known]
    made = []
    for n, offer, values in zip(known, offers, bank.solve_together(offers)[1], strict=True):
        q, mean = np.zeros(len(bank.offers)), np.zeros(len(bank.along))
        q[n] = 1.0
        np.add.at(mean, list(offer.column_numbers), values)
        made.append(SingleEffect(bank.offers, q, mean))
    return made


def _add_effects(
    bank: OfferBank, start: Sequence[SingleEffect], excluded: frozenset[int], most: int
) -> Explanation:
    """Add single effects to `start`, until a new one is probably absent or there are `most`.

    The offers whose numbers are in `excluded` are excluded.
    """
    effects = list(start)
    while len(effects) < most:
        count = len(effects)
        none = np.zeros(len(bank.offers)), np.zeros(len(bank.along))
        effects.append(SingleEffect(bank.offers, *none))
        effects = [e for e in _sweep_effects(bank, effects, excluded) if e.presence > 0.5]
        if len(effects) <= count:
            break
    return Explanation(bank, tuple(effects))


def _sweep_effects(
    bank: OfferBank, effects: list[SingleEffect], excluded: frozenset[int]
) -> list[SingleEffect]:
    """Update each effect from the residual of the others until no probability changes any more."""
    taken = np.sum([e.mean for e in effects], axis=0)
    for _ in range(ROUNDS):
        moved = 0.0
        for k in reversed(range(len(effects))):
            was = effects[k]
            rest = taken - was.mean
            others = OtherEffects.of([*effects[:k], *effects[k + 1 :]], excluded)
            now = bank.compute_single_effect(bank.along - bank.gram @ rest, others)
            moved = max(
                moved, float(np.abs(now.probabilities - was.probabilities).max(initial=0.0))
            )
            effects[k], taken = now, rest + now.mean
        if moved < UNLIKELY:
            break
    return effects


def _drop_superfluous(found: Explanation) -> Explanation:
    """Return the explanation without effects that do not raise its evidence, priors included."""
    kept = found.bank.worth_their_price(found.offers)
    return Explanation(found.bank, tuple(found.effects[k] for k in kept))
