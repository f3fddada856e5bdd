"""Chooses the functions without a name to offer beside the library: the best of a large bank."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.context import WIDTH
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.linear import Marginal
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.discovered import COMPONENTS, Move, Turn
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.quantities import AXES
from longarm_comp.core.effects.shapes import Function, Shape, Threshold, Wave
from longarm_comp.core.identify.discover.bank import (
    CAMERA,
    SHORTLIST,
    FunctionBank,
    FunctionCandidate,
    make_banks,
    make_term,
)
from longarm_comp.core.identify.discover.functions import REFINED, vary_shape
from longarm_comp.core.identify.discover.inputs import FINE_GRID
from longarm_comp.core.identify.model_tolerance import RIGID, ModelTolerance
from longarm_comp.core.identify.posterior.found import FoundEffect, ProposedFunction, keys_of
from longarm_comp.core.identify.posterior.offers import tolerance_columns


def propose_functions(
    fit: ModelFit,
    found: Sequence[FoundEffect],
    library: Sequence[Candidate] = (),
    tolerance: ModelTolerance = RIGID,
) -> tuple[ProposedFunction, ...]:
    """Return the functions that explain most: beside all found effects, and instead of each one.

    The best of every kind is among them, because one curve may be described by functions of
    several kinds.  No function is proposed instead of an elastic effect: every arm yields, and a
    function does not tell how much under another load.

    Args:
        fit: the fit of the geometry and the found effects.
        found: the effects found so far.
        library, tolerance: give the columns that may move the rows besides (`tolerance_columns`).
    """
    fit = dataclasses.replace(fit, rho=0.0)  # functions are tried as if rows erred independently
    gone: list[Sequence[FoundEffect]] = [(), *([f] for f in found if not f.terms[0].elastic)]
    marginals = []
    for some in gone:
        rest = [f for f in found if f not in some]
        besides = tolerance_columns(fit, library, rest, tolerance)
        columns = [fit.design[:, _mask_other_columns(fit, some)], besides]
        marginals.append(Marginal(np.concatenate(columns, axis=1), fit.data))
    history = {
        joint
        for f in found
        for t in f.terms
        if isinstance(t, Effect) and not WIDTH.keys().isdisjoint(t.inputs)
        for joint in t.history_joints(fit.model.arm)
    }
    ranked: list[list[_Ranked]] = [[] for _ in gone]
    for bank in make_banks(fit, history):
        looked = bank.shortlist_candidates(
            _mask_other_columns(fit, found), [marginal.projected_data for marginal in marginals]
        )
        for marginal, kinds, mine in zip(marginals, looked, ranked, strict=True):
            mine += _rank_bank(bank, marginal, kinds)
    few = SHORTLIST // 2 if found else SHORTLIST
    offered: dict[FunctionCandidate, FunctionBank] = {}
    for mine in ranked:
        better = sorted((one for one in mine if one.worth > 0), key=lambda one: -one.worth)
        offered |= {one.candidate: one.bank for one in better[:few]}
        offered |= {one.candidate: one.bank for one in better if one.first}
        few = SHORTLIST // (2 * max(len(gone) - 1, 1))  # functions instead of each effect
    made = []
    for candidate, bank in offered.items():
        # One prior standard deviation of each moves the rows by one noise, rms, times its decay
        scales = np.array(candidate.decay) / bank.unit_shifts(candidate)
        terms = tuple(
            make_term(spot, f.text, f.domain, float(scale))
            for (spot, f), scale in zip(candidate.members, scales, strict=True)
        )
        made.append(ProposedFunction(terms, candidate.log_prior))
    return tuple(made)


class _Ranked(NamedTuple):
    """A candidate, its log odds, and whether it is the best of its kind."""

    worth: float
    candidate: FunctionCandidate
    bank: FunctionBank
    first: bool = False


def _rank_bank(
    bank: FunctionBank, marginal: Marginal, kinds: Sequence[Sequence[FunctionCandidate]]
) -> list[_Ranked]:
    """Return the best of the candidates of each kind, and the very best also in refined form."""
    made, each = [], SHORTLIST // len(kinds)  # so that similar functions leave room for others
    for some in kinds:
        weighed = _rank_by_odds(bank, marginal, [c for c in some if not _is_constant_shift(c)])
        made += [_Ranked(worth, c, bank, n == 0) for n, (worth, c) in enumerate(weighed[:each])]
    made.sort(key=lambda one: -one.worth)
    best = [(one.worth, one.candidate) for one in made[:REFINED]]
    refined = (_Ranked(worth, c, bank) for worth, c in _refine_shapes(bank, marginal, best))
    return [*made, *refined]


def _mask_other_columns(fit: ModelFit, found: Sequence[FoundEffect]) -> np.ndarray:
    """Return (p,) True for each column of a fit that does not belong to the effects `found`."""
    of = keys_of(found)
    return np.array([s.owner.key not in of for s in fit.slots], dtype=bool)


def _rank_by_odds(
    bank: FunctionBank, marginal: Marginal, few: Sequence[FunctionCandidate]
) -> list[tuple[float, FunctionCandidate]]:
    """Return (log odds, candidate) of each candidate, the best first."""
    worth = bank.log_odds_of(marginal, few).tolist()
    return sorted(zip(worth, few, strict=True), key=lambda each: -each[0])


def _is_constant_shift(candidate: FunctionCandidate) -> bool:
    """Tell whether a candidate is a constant displacement, which geometry can explain."""
    still = all(not function.factors for _, function in candidate.members)
    rigid = (
        isinstance(COMPONENTS.get(spot.component), (Move, Turn)) for spot, _ in candidate.members
    )
    seen = (spot.at == CAMERA and spot.component in AXES for spot, _ in candidate.members)
    return still and all(a or b for a, b in zip(rigid, seen, strict=True))


def _refine_shapes(
    bank: FunctionBank, marginal: Marginal, first: Sequence[tuple[float, FunctionCandidate]]
) -> Iterator[tuple[float, FunctionCandidate]]:
    """Yield each candidate with its best thresholds or frequencies: a coarse and a fine search."""
    for best in first:
        prior = best[1].log_prior - math.log(REFINED)
        for width in (1.0, 2.0 / (FINE_GRID - 1)):  # then between the neighbours of the best
            tried = (
                dataclasses.replace(c, log_prior=prior)
                for c in _vary_candidate(bank, best[1], width)
            )
            best = max(
                (best, *_rank_by_odds(bank, marginal, list(tried))), key=lambda each: each[0]
            )
        yield best


def _vary_candidate(
    bank: FunctionBank, candidate: FunctionCandidate, width: float
) -> Iterator[FunctionCandidate]:
    """Yield the candidate with other thresholds or frequencies near its own (`vary_shape`)."""
    factors = dict.fromkeys(f for _, function in candidate.members for f in function.factors)
    bent = [f for f in factors if isinstance(f, (Threshold, Wave))]
    if len(bent) == 1 or all(isinstance(f, Wave) for f in bent):
        by_name = bank.functions.inputs.by_name
        for moved in zip(*(vary_shape(f, by_name[f.of], width) for f in bent), strict=True):
            other: dict[Shape, Shape] = dict(zip(bent, moved, strict=True))
            members = tuple(
                (spot, Function(tuple(other.get(f, f) for f in function.factors)))
                for spot, function in candidate.members
            )
            yield dataclasses.replace(candidate, members=members)
