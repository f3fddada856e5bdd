"""The other explanations that the rows leave possible, as the promise of a command needs them.

The law of total covariance: an error about the model's tip is that within each explanation, and the
distance to the explanation's tip.  Explanations differ by the names, places and forms of the found
effects, by their absence, and by the presence of doubtful ones.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.calibration import linear
from longarm_comp.core.calibration.candidates import Term
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit, prior_bounds, prior_widths
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.posterior.found import FoundEffect, keys_of
from longarm_comp.core.identify.posterior.offer import UNLIKELY
from longarm_comp.core.model.model import slots_of
from longarm_comp.core.model.uncertainty import Alternative

MOST = 8
"""Largest number of alternatives, each of which every command computes; the likeliest stand for
all."""


@dataclass(frozen=True)
class _Change:
    """Effects that replace others, with the probability of that."""

    chance: float
    gone: frozenset[tuple[str, str]] = frozenset()
    terms: tuple[Term, ...] = ()


def weigh_alternatives(
    fit: ModelFit, found: Sequence[FoundEffect], doubtful: Sequence[FoundEffect]
) -> tuple[Alternative, ...]:
    """List the explanations that may be true instead of that of a fitted model.

    Found effects that the model does not hold are left out: their proof failed.  So is what is
    `UNLIKELY`, which hardly moves the radius of 90 of 100 commands, and what moves no tip.
    """
    held = {t.key for t in fit.model.terms}
    mine = [f for f in found if held.issuperset(t.key for t in f.terms)]
    sets = [list(_changes_of(f, mine)) for f in mine]
    sets += [[_Change(f.presence, terms=f.terms)] for f in doubtful]
    every = [_Change(1.0)]
    for changes in sets:
        stays = 1.0 - sum(c.chance for c in changes)
        every = [
            _Change(e.chance * c.chance, e.gone | c.gone, e.terms + c.terms)
            for e in every
            for c in (_Change(stays), *changes)
            if e.chance * c.chance >= UNLIKELY
        ]
    fixed = {t.key for t in fit.model.terms if not slots_of(fit.model.arm, [t])}
    others = sorted((e for e in every if e.gone or e.terms), key=lambda e: -e.chance)
    shown = [
        e
        for e in others
        if fixed.isdisjoint(e.gone) and all(slots_of(fit.model.arm, [t]) for t in e.terms)
    ]
    kept = shown[:MOST]
    share = sum(e.chance for e in shown) / (sum(e.chance for e in kept) or 1.0)
    return tuple(_make_alternative(fit, e, share * e.chance) for e in kept)


def _changes_of(found: FoundEffect, every: Sequence[FoundEffect]) -> Iterator[_Change]:
    """Yield what may be true instead of a found effect, its absence first.

    A named rival also replaces all other effects of its name.
    """
    own = frozenset(t.key for t in found.terms)
    yield _Change(1.0 - found.presence, own)
    odds = [math.exp(value) for _, value in found.otherwise]
    for (candidate, _), each in zip(found.otherwise, odds, strict=True):
        share = found.presence * found.cause.probability * each / (1.0 + sum(odds))
        yield _Change(share, own, candidate.terms)
    for rival in found.rivals:
        same = () if rival.unnamed else [f for f in every if f.name == rival.name]
        chance = found.presence * rival.probability
        yield _Change(chance, own | keys_of(same), rival.candidate.terms)


def _make_alternative(fit: ModelFit, change: _Change, chance: float) -> Alternative:
    """Fit the other effects in the place of those that go, by the columns of a fit.

    An effect that goes and comes in the same form stays.
    """
    same = {t.variant for t in change.terms}
    leaves = {t.key for t in fit.model.terms if t.variant not in same} & change.gone
    held = {t.key for t in fit.model.terms} - leaves
    new = tuple({t.key: t for t in change.terms if t.key not in held}.values())
    fixed = np.array([s.owner.through_others for s in fit.slots], bool)
    stays = np.array([s.owner.key not in leaves for s in fit.slots], bool) & ~fixed
    kept = [s for s, stay in zip(fit.slots, stays, strict=True) if stay]
    slots = (*kept, *slots_of(fit.model.arm, new))
    width = prior_widths(slots)
    values = fit.model.values / prior_widths(fit.slots)
    data = fit.data - fit.design[:, fixed] @ values[fixed]
    design = np.concatenate([fit.design[:, stays], FitColumns(fit).white_columns(new)], axis=1)
    fitted = linear.solve_products(design.T @ design, design.T @ data, *prior_bounds(slots))
    covariance = fitted.covariance * np.outer(width, width)
    own = slice(len(kept), None)
    ways = np.linalg.solve(np.linalg.cholesky(covariance[own, own]), covariance[own])
    before = np.array([s.value if s.owner.key in held else 0.0 for s in slots])
    gone = [s for s in fit.slots if s.owner.key in leaves]
    moves = np.zeros((1 + len(ways), len(slots) + len(gone)))
    moves[0] = [*(fitted.u * width - before), *(-s.value for s in gone)]
    moves[1:, : len(slots)] = ways
    terms = tuple(t for t in new if isinstance(t, Effect))
    return Alternative(chance, tuple(s.identity for s in (*slots, *gone)), moves, terms)
