"""What may explain a session, as one bank of offers: the library and functions without a name.

Every name is as likely as any other beforehand.  Its probability is divided among its places and
forms.  Functions without a name have a twentieth together.  Beside each effect in the model stands
what its form may leave: no effect's form is right to better than a tenth (`TOLERANCE`).
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Term, distinct
from longarm_comp.core.identify.evidence import FitColumns, shift_of
from longarm_comp.core.identify.give import a_little
from longarm_comp.core.identify.linear import CHANCES, SIZES, Marginal
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.plausible import INCREDIBLE
from longarm_comp.core.identify.posterior.found import UNNAMED, FoundEffect, Proposition
from longarm_comp.core.identify.posterior.offered_effects import OfferedEffects
from longarm_comp.core.identify.posterior.single_effects import NONE, Offer, OfferBank
from longarm_comp.core.identify.posterior.tolerance import Slack
from longarm_comp.core.identify.structure import smooth_in
from longarm_comp.core.model.model import slots_of

AMPLITUDES = (3.0, 30.0, 300.0)
"""Of a function without a name: prior standard deviations of its shift, in units of the noise."""


def offered(
    fitted: ModelFit,
    columns: FitColumns,
    library: Sequence[Candidate],
    functions: Sequence[Proposition],
    found: Sequence[FoundEffect],
    tolerance: Slack,
    *,
    others: bool = True,
) -> OfferedEffects:
    """The bank at a fit.

    Args:
        fitted: geometry and what was found so far.
        columns: of candidates at its rows.
        library: the named effects.
        functions: without a name.
        found: what was found so far; it stays on offer in its present form.
        tolerance: what may move the rows besides.
        others: whether more than these is on offer.
    """
    arm = fitted.model.arm
    names = {c.name for c in library}
    forms = Counter(c.name for c in library)
    share = math.log((1.0 - UNNAMED) / max(len(names), 1))
    listed: list[_Listed] = []
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
    if not others:
        kept = {tuple(t.variant for t in f.terms) for f in found}
        listed = [entry for entry in listed if tuple(t.variant for t in entry[0].terms) in kept]
    held = {t.key for f in found for t in f.terms}
    beside = tolerances(fitted, columns, library, found, tolerance)
    marginal = columns.without(held, beside)
    moving, bank, widths = _banked(fitted, marginal, columns, listed)
    things = [listed[n][0] for n in moving]
    at = {tuple(t.variant for t in c.terms): n for n, c in enumerate(things)}
    known = (at.get(tuple(t.variant for t in f.terms)) for f in found)
    return OfferedEffects(
        fitted,
        things,
        bank,
        widths,
        tuple(n for n in known if n is not None),
        marginal.evidence,
        tolerance,
    )


_Listed = tuple[Candidate, float, tuple[float, ...], tuple[float, ...]]
"""A candidate with the log prior, sizes and chances of its offer."""


def _banked(
    fitted: ModelFit, marginal: Marginal, columns: FitColumns, listed: Sequence[_Listed]
) -> tuple[list[int], OfferBank, np.ndarray]:
    """Which candidates move a row; these as a bank; units of its columns."""
    arm = fitted.model.arm
    terms = list({t.variant: t for c, _, _, _ in listed for t in c.terms}.values())
    b, where, lower, upper, widths, like = _columns(fitted, columns, terms)
    gram, along = marginal.normal(b)
    offers, kept = [], []
    for n, (candidate, prior, sizes, chances) in enumerate(listed):
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
        kept.append(n)
    return kept, OfferBank(offers, gram, along, lower, upper, like), widths


def evidence_of_each(
    fitted: ModelFit, marginal: Marginal, columns: FitColumns, each: Sequence[Candidate]
) -> np.ndarray:
    """(C,) log Bayes factor of each candidate alone on top of a marginal, its own price paid.

    0 of one that moves no row.

    Args:
        fitted: whose rows, noise and weights count.
        marginal: what is there already.
        columns: of candidates at the fit's rows.
        each: the candidates.
    """
    listed = [(c, NONE - sum(t.price(fitted.model.arm) for t in c.terms), (1.0,), (0.0,))
              for c in each]  # fmt: skip
    kept, bank, _ = _banked(fitted, marginal, columns, listed)
    made = np.zeros(len(listed))
    made[kept] = bank.scores
    return made


def tolerances(
    fitted: ModelFit,
    columns: FitColumns,
    library: Sequence[Candidate],
    found: Sequence[FoundEffect],
    tolerance: Slack,
) -> np.ndarray | None:
    """(m, k) whitened: what is there besides what was found, and no finding.

    That is what every arm has (`Parameter.usual`, `give.py`), and by how much the shift of each
    effect in the model may differ from its form.  The latter varies with every joint, smoothly.  A
    row so near to a threshold that the threshold's own tolerance decides its side says nothing of
    that side.
    """
    session = fitted.session
    ways = np.concatenate([smooth_in(q)[:, :2] for q in session.q.T], axis=1)
    ways = ways * (tolerance.form / math.sqrt(max(ways.shape[1], 1)))
    arm = fitted.model.arm
    usual = [t for t in distinct(library) if any(p.usual for p in t.parameters(arm))]
    shares = [s.parameter.usual / s.parameter.width for s in slots_of(arm, usual)]
    made = [columns.of(usual) * shares] if usual else []
    if tolerance.give:
        made.append(a_little(fitted, columns, library))
    held = {t.key: t for t in fitted.model.terms}
    for f in found:
        terms = [held[t.key] for t in f.terms if t.key in held]
        if terms:
            shift = shift_of(fitted, columns, terms)
            made.append(shift[:, :, None] * ways[:, None, :])
            made += [_undecided(fitted, columns, t, tolerance.form) for t in terms if t.scales()]
    return fitted.whitened(np.concatenate(made, axis=-1)) if made else None


def _undecided(fitted: ModelFit, columns: FitColumns, term: Term, tolerance: float) -> np.ndarray:
    """(N, d, k) what a form's tolerance changes at single rows: more than its share of all."""
    largest = np.abs(shift_of(fitted, columns, [term])).max()
    made = []
    for field, (low, high) in term.scales().items():
        value = getattr(term, field)
        ends = (min(value * (1 + tolerance), high), max(value * (1 - tolerance), low))
        up, down = (dataclasses.replace(term, **{field: end}) for end in ends)
        change = (shift_of(fitted, columns, [up]) - shift_of(fitted, columns, [down])) / 2
        rows = np.flatnonzero(np.abs(change).max(axis=1) > tolerance * largest)
        alone = np.zeros((*change.shape, len(rows)))
        alone[rows, :, np.arange(len(rows))] = change[rows]
        made.append(alone)
    return np.concatenate(made, axis=-1)


def _columns(
    fitted: ModelFit, columns: FitColumns, terms: Sequence[Term]
) -> tuple[np.ndarray, dict, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Columns of all terms side by side, with their bounds, units and likenesses."""
    arm = fitted.model.arm
    free = [t for t in terms if slots_of(arm, [t])]
    whole = [t for t in terms if not slots_of(arm, [t])]
    scaled = columns.scaled(free)
    most = np.array([INCREDIBLE if s.owner.searched else np.inf for s in slots_of(arm, free)])
    parts = [scaled.b]
    where: dict[tuple[object, ...], tuple[int, ...]] = {}
    start = 0
    for term in free:
        count = len(slots_of(arm, [term]))
        where[term.variant] = tuple(range(start, start + count))
        start += count
    lower, upper = [np.maximum(scaled.lower, -most)], [np.minimum(scaled.upper, most)]
    widths = [scaled.widths]
    for term in whole:
        parts.append(fitted.whitened(columns.shift([term])[..., None]))
        where[term.variant] = (start,)
        start += 1
        lower.append(np.full(1, -np.inf))
        upper.append(np.full(1, np.inf))
        widths.append(np.ones(1))
    first: dict[object, int] = {}
    like = [
        first.setdefault((*s.owner.variant, s.parameter.like) if s.parameter.like else k, k)
        for k, s in enumerate(slots_of(arm, free))
    ]
    return (
        np.concatenate(parts, axis=1),
        where,
        np.concatenate(lower),
        np.concatenate(upper),
        np.concatenate(widths),
        np.array([*like, *range(len(like), start)]),
    )
