"""Makes the bank of offers of a session: the library, and functions without a name.

Every name has the same prior probability, which is divided among its places and forms.  All
functions without a name together have the prior probability `UNNAMED`.  For each effect in the
model there are further columns, because the form of no effect is exact (`FORMS`).
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.candidates import Candidate, Term, distinct_terms, list_variants
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.linear import CHANCES, SIZES, Marginal, marginalise_first
from longarm_comp.core.calibration.model_fit import ModelFit, prior_bounds, prior_widths
from longarm_comp.core.calibration.plausible import INCREDIBLE
from longarm_comp.core.identify.model_tolerance import ModelTolerance, background_columns
from longarm_comp.core.identify.posterior.found import (
    NONE,
    UNNAMED,
    FoundEffect,
    ProposedFunction,
    keys_of,
)
from longarm_comp.core.identify.posterior.offer import Offer
from longarm_comp.core.identify.posterior.offer_bank import OfferBank
from longarm_comp.core.identify.posterior.offer_table import Coefficients
from longarm_comp.core.identify.posterior.offered_effects import OfferedEffects
from longarm_comp.core.identify.structure import legendre_polynomials
from longarm_comp.core.model.model import slots_of

AMPLITUDES = (3.0, 30.0, 300.0)
"""Possible prior standard deviations of the shift by a function without a name, in units of the
noise. Each is ten times that before: nobody knows beforehand how large it is."""


def make_offers(
    fitted: ModelFit,
    library: Sequence[Candidate],
    functions: Sequence[ProposedFunction],
    found: Sequence[FoundEffect],
    tolerances: Sequence[ModelTolerance],
    *,
    others: bool = True,
    near: ModelFit | None = None,
    counts: np.ndarray | None = None,
) -> list[OfferedEffects]:
    """Make the offers at a fit, one bank for each tolerance.

    Args:
        fitted: the fit of geometry and of what was found so far.
        library: the named effects.
        functions: functions without a name.
        found: the effects found so far; they stay on offer in their present form.
        others: whether to offer more than `found`.
        near: a similar fit with the same rows and noise, at which the background columns are
            computed. Default: `fitted`.
        counts: (N,) how often each row counts; None: once.
    """
    arm = fitted.model.arm
    listed = _list_with_prices(arm, library, functions, found)
    if not others:
        now = {list_variants(f.terms) for f in found}
        listed = [each for each in listed if list_variants(each.candidate.terms) in now]
    stacked = _stack_columns(fitted, listed)
    marginal = FitColumns(fitted).marginal_without(keys_of(found))
    tolerated, sizes = _list_tolerance_columns(fitted, library, found, tolerances, near)
    columns = np.concatenate([tolerated, stacked.b], axis=1)
    if counts is not None:
        root = np.sqrt(np.repeat(counts[fitted.weights > 0], fitted.width))
        marginal = Marginal(root[:, None] * marginal.a, root * marginal.y)
        columns = root[:, None] * columns
    gram, along = marginal.project_products(columns)
    own = slice(tolerated.shape[1], None)
    moving, plain = _make_offers_that_move(arm, np.diag(gram)[own], stacked, listed)
    every = OfferBank(plain, gram[own, own], along[own], stacked.coefficients)
    kept = [n for n, offer in enumerate(plain) if not every.imitates_a_name(offer)]
    candidates, plain = [listed[moving[n]].candidate for n in kept], [plain[n] for n in kept]
    at = {list_variants(c.terms): n for n, c in enumerate(candidates)}
    known = tuple(at[list_variants(f.terms)] for f in found if list_variants(f.terms) in at)
    names = len({c.name for c in library})
    banks = []
    for tolerance, size in zip(tolerances, sizes, strict=True):
        evidence, s, t = marginalise_first(gram, along, size)
        share = min(tolerance.compliance, 1.0) or 1.0  # the stiffer the arm, the smaller
        offers = [
            dataclasses.replace(offer, sizes=tuple(share * s for s in offer.sizes))
            if candidate.terms[0].elastic and not offer.fixed
            else offer
            for offer, candidate in zip(plain, candidates, strict=True)
        ]
        bank = OfferBank(offers, s, t, stacked.coefficients, arm.n, names)
        base, widths = marginal.evidence + evidence + tolerance.log_prior, stacked.widths
        banks.append(OfferedEffects(fitted, candidates, bank, widths, known, base, tolerance))
    return banks


class _Listed(NamedTuple):
    """A candidate, and the log prior, sizes and chances of its `Offer`."""

    candidate: Candidate
    log_prior: float
    sizes: tuple[float, ...] = (1.0,)
    chances: tuple[float, ...] = (0.0,)


def _list_with_prices(
    arm: Arm,
    library: Sequence[Candidate],
    functions: Sequence[ProposedFunction],
    found: Sequence[FoundEffect],
) -> list[_Listed]:
    """List the candidates on offer: the library, the functions, and what was found so far."""
    forms = Counter(c.name for c in library)
    share = math.log((1.0 - UNNAMED) / max(len(forms), 1))
    listed: list[_Listed] = []
    for candidate in library:
        price = sum(t.price(arm) for t in candidate.terms)
        prior = share - math.log(forms[candidate.name]) - price
        listed.append(_Listed(candidate, prior, SIZES, CHANCES))
    even = (-math.log(len(AMPLITUDES)),) * len(AMPLITUDES)
    for function in functions:
        candidate = Candidate(function.terms[0].name, function.terms)
        prior = math.log(UNNAMED) + function.log_prior
        listed.append(_Listed(candidate, prior, AMPLITUDES, even))
    offered_now = {list_variants(each.candidate.terms) for each in listed}
    for f in found:
        if list_variants(f.terms) not in offered_now:
            prior = share - math.log(forms[f.name]) if f.name in forms else math.log(UNNAMED)
            prior = prior if f.cause.log_prior is None else f.cause.log_prior
            sizes = (AMPLITUDES, even) if f.unnamed and not f.cause.loose else (SIZES, CHANCES)
            listed.append(_Listed(f.cause.candidate, prior, *sizes))
    return listed


def _make_offers_that_move(
    arm: Arm, squares: np.ndarray, stacked: _StackedColumns, listed: Sequence[_Listed]
) -> tuple[list[int], list[Offer]]:
    """Return the candidates that move a row, by their positions in `listed`, and their offers.

    `squares` (k,) are the squared lengths of all columns, with the geometry projected out.
    """
    offers, kept = [], []
    for n, (candidate, prior, sizes, chances) in enumerate(listed):
        own = tuple(stacked.where[t.variant] for t in candidate.terms)
        flat = [k for part in own for k in part]
        if not flat or not np.isfinite(squares[flat]).all() or not squares[flat].any():
            continue
        fixed = not candidate.slots(arm)
        keys = tuple(t.key for t in candidate.terms)
        if fixed:
            sizes, chances = (1.0,), (0.0,)
        sites = {"" if t.searched else t.where.partition(",")[0] for t in candidate.terms}
        site = sites.pop() if len(sites) == 1 else ""
        offers.append(Offer(candidate.name, keys, own, prior, sizes, chances, fixed, site))
        kept.append(n)
    return kept, offers


def evidence_of_each(fitted: ModelFit, marginal: Marginal, each: Sequence[Candidate]) -> np.ndarray:
    """Return the (C,) log Bayes factor of each candidate alone against none.

    Its price (`Effect.price`) is subtracted. A candidate that moves no row has 0. `marginal` holds
    the columns that are in the model already.
    """
    arm = fitted.model.arm
    listed = [_Listed(c, NONE - sum(t.price(arm) for t in c.terms)) for c in each]
    stacked = _stack_columns(fitted, listed)
    gram, along = marginal.project_products(stacked.b)
    moving, offers = _make_offers_that_move(arm, np.diag(gram), stacked, listed)
    made = np.zeros(len(listed))
    made[moving] = OfferBank(offers, gram, along, stacked.coefficients).scores
    return made


def tolerance_columns(
    fitted: ModelFit,
    library: Sequence[Candidate],
    found: Sequence[FoundEffect],
    tolerance: ModelTolerance,
) -> np.ndarray:
    """Return (m, k) whitened columns of a model tolerance, each multiplied by its size.

    They are what may move the rows besides the findings.
    """
    made, (sizes,) = _list_tolerance_columns(fitted, library, found, [tolerance])
    return (made * sizes)[:, sizes > 0]


def _list_tolerance_columns(
    fitted: ModelFit,
    library: Sequence[Candidate],
    found: Sequence[FoundEffect],
    tolerances: Sequence[ModelTolerance],
    near: ModelFit | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the columns that model tolerances allow besides the findings.

    They are what every arm has a little of (`model_tolerance.py`), and errors of the forms of the
    found effects.  The error of a form varies with every joint by its `_principal_functions`.  A
    row so near to a threshold that the tolerance decides its side gets a column of its own, so its
    side has no influence.

    Returns (m, k) whitened columns, and (S, k) their sizes by each of S tolerances.
    """
    session = fitted.session
    ways = np.concatenate([_principal_functions(q) for q in session.q.T], axis=1)
    ways = ways / math.sqrt(max(ways.shape[1], 1))
    arm = fitted.model.arm
    forms = np.array([tolerance.form for tolerance in tolerances])
    usual = [t for t in distinct_terms(library) if any(p.usual for p in t.parameters(arm))]
    shares = [s.parameter.usual / s.parameter.width for s in slots_of(arm, usual)]
    made, sizes = [FitColumns(fitted).white_columns(usual)], [np.tile(shares, (len(forms), 1))]
    if any(tolerance.compliance for tolerance in tolerances):
        little, size = background_columns(FitColumns(near or fitted), library, tolerances)
        made.append(little)
        sizes.append(size)
    held = {t.key: t for t in fitted.model.terms}
    moving = [held[t.key] for f in found for t in f.terms if t.key in held and t.scales()]
    ends = [e for t in moving for form in np.unique(forms) for e in _scale_ends(t, float(form))]
    # All at once: much faster
    FitColumns(fitted).prior_columns([end for pair in ends for end in pair])
    for f in found:
        terms = [held[t.key] for t in f.terms if t.key in held]
        if terms:
            shift = FitColumns(fitted).shift_by(terms)
            made.append(fitted.whiten_columns(shift[:, :, None] * ways[:, None, :]))
            sizes.append(forms[:, None] * np.ones(ways.shape[1]))
            for term in terms:
                for form in np.unique(forms).tolist() if term.scales() else ():
                    made.append(fitted.whiten_columns(_undecided_row_columns(fitted, term, form)))
                    sizes.append((forms == form)[:, None] * np.ones(made[-1].shape[1]))
    return np.concatenate(made, axis=1), np.concatenate(sizes, axis=1)


def _principal_functions(values: np.ndarray) -> np.ndarray:
    """Compute two principal components (N, k) of the Legendre polynomials of a joint (N,).

    Two are a compromise. With a line and a parabola instead, an error of a form explained a gain of
    1 % beside a soft joint. With all six polynomials the palletiser's model left a structure in
    time.
    """
    ways, sizes, _ = np.linalg.svd(legendre_polynomials(values), full_matrices=False)
    return (ways * math.sqrt(len(values)))[:, sizes > 1e-6 * sizes.max(initial=0.0)][:, :2]


def _undecided_row_columns(fitted: ModelFit, term: Term, tolerance: float) -> np.ndarray:
    """Return (N, d, k) columns, each the change of one row's shift by an error of a term's scales.

    Only a row near a threshold has one: its change exceeds `tolerance` times the largest shift.

    Args:
        tolerance: relative error of the scales.
    """
    columns = FitColumns(fitted)
    largest = np.abs(columns.shift_by([term])).max()
    made = []
    for up, down in _scale_ends(term, tolerance):
        change = (columns.shift_by([up]) - columns.shift_by([down])) / 2
        rows = np.flatnonzero(np.abs(change).max(axis=1) > tolerance * largest)
        alone = np.zeros((*change.shape, len(rows)))
        alone[rows, :, np.arange(len(rows))] = change[rows]
        made.append(alone)
    return np.concatenate(made, axis=-1)


def _scale_ends(term: Term, tolerance: float) -> list[tuple[Term, Term]]:
    """Return for each scale of a term two terms: with it larger and smaller, within its limits."""
    made = []
    for field, (low, high) in term.scales().items():
        value = getattr(term, field)
        ends = (min(value * (1 + tolerance), high), max(value * (1 - tolerance), low))
        up, down = (dataclasses.replace(term, **{field: end}) for end in ends)
        made.append((up, down))
    return made


class _StackedColumns(NamedTuple):
    """Columns of all terms on offer side by side.

    Attributes:
        b: (m, k) columns in units of the noise.
        where: positions of a term's columns, by its variant.
        widths: (k,) units of the columns: a parameter's value is its coefficient times this.
        coefficients: the coefficients of the columns.
    """

    b: np.ndarray
    where: dict[tuple[object, ...], tuple[int, ...]]
    widths: np.ndarray
    coefficients: Coefficients


def _stack_columns(fitted: ModelFit, listed: Sequence[_Listed]) -> _StackedColumns:
    """Stack the columns of the listed terms, each variant once, those of parameters first.

    A term without parameters has one column, its shift.
    """
    terms = list({t.variant: t for each in listed for t in each.candidate.terms}.values())
    slots = slots_of(fitted.model.arm, terms)
    of_term: dict[int, list[int]] = {}
    for k, slot in enumerate(slots):
        of_term.setdefault(slot.term, []).append(k)
    where = {terms[t].variant: tuple(own) for t, own in of_term.items()}
    columns = FitColumns(fitted)
    widths = prior_widths(slots)
    whole = [term for t, term in enumerate(terms) if t not in of_term]
    where |= {term.variant: (len(slots) + k,) for k, term in enumerate(whole)}
    shifts = [fitted.whiten_columns(columns.shift_by([term])[..., None]) for term in whole]
    lower, upper = prior_bounds(slots)
    most = np.array([INCREDIBLE if s.owner.searched else np.inf for s in slots])
    free = np.full(len(whole), np.inf)
    first: dict[object, int] = {}
    like = [
        first.setdefault((*s.owner.variant, s.parameter.like) if s.parameter.like else k, k)
        for k, s in enumerate(slots)
    ]
    return _StackedColumns(
        b=np.concatenate([columns.white_columns([terms[t] for t in of_term]), *shifts], axis=1),
        where=where,
        widths=np.concatenate([widths, np.ones(len(whole))]),
        coefficients=Coefficients(
            np.concatenate([np.maximum(lower, -most), -free]),
            np.concatenate([np.minimum(upper, most), free]),
            np.array([*like, *range(len(slots), len(slots) + len(whole))], dtype=int),
        ),
    )
