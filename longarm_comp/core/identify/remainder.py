"""Remainders: a weak effect may be no more than the misfit of a stronger one's form.

No real part follows its formula exactly: a stronger effect may differ from it along its joint and
its load.  A weaker name that loses most of its evidence to such differences is withdrawn, if the
rest would not be accepted, or if the differences alone explain more than the name alone.  What it
stood for stays in the residual, as structure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, CandidateColumns, Term
from longarm_comp.core.identify.evidence import columns_at, key, marginal_without, score, shift_of
from longarm_comp.core.identify.fit import ModelFit
from longarm_comp.core.identify.minor import Minor, families, worth
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.structure import smooth_in

VARIES = 0.3
"""Share by which the shift of an effect may differ from its form (prior standard deviation)."""
BENDS = 3
"""Functions of a joint or a load, by order, that the difference may follow."""
SHARED = 0.5
"""Share of its evidence that a weaker name must lose to such differences."""


def without_remainders(
    result: SearchResult, say: Callable[[str], None]
) -> tuple[SearchResult, tuple[Minor, ...]]:
    """The search's result without such names, the rest fitted again, and these; weakest first."""
    gone: list[Minor] = []
    while True:
        found = _weakest(result)
        if found is None:
            return result, tuple(gone)
        terms, minor = found
        say(f"without {minor.name}: {minor.why}")
        result = result.without({key(t) for t in terms})
        gone.append(minor)


def _weakest(result: SearchResult) -> tuple[tuple[Term, ...], Minor] | None:
    """The weakest family that stronger ones may stand for, with the reason."""
    fit, columns = result.fit, columns_at(result.fit)
    found = families(result)
    own = {}
    for name, terms in found.items():
        marginal = marginal_without(fit, columns, {key(t) for t in terms})
        own[name] = score(fit, marginal, Candidate(name, terms), columns).log_bayes_factor
    order = sorted(found, key=lambda name: own[name])
    for k, name in enumerate(order[:-1]):
        terms = found[name]
        stronger = [t for other in order[k + 1 :] for t in found[other]]
        marginal = marginal_without(fit, columns, {key(t) for t in terms})
        forms = variations(fit, columns, stronger)
        bent = marginal_without(fit, columns, {key(t) for t in terms}, forms)
        left = score(fit, bent, Candidate(name, terms), columns).log_bayes_factor
        alone = marginal.added(forms).log_bayes_factor
        if left < SHARED * own[name] and (left < result.threshold or alone > own[name]):
            why = f"{', '.join(order[:k:-1])} may differ from its form instead, by {VARIES:.0%}"
            places = tuple(dict.fromkeys(t.where for t in terms))
            return terms, Minor(name, places, worth(fit, columns, terms), why)
    return None


def variations(fit: ModelFit, columns: CandidateColumns, terms: Sequence[Term]) -> np.ndarray:
    """(dM, k) whitened columns: the shifts of terms times functions of their joints and loads."""
    rows, arm = fit.session, fit.model.arm
    made = []
    for term in terms:
        moved = shift_of(fit, columns, [term])
        joints = [arm.commanded.index(j) for j in term.joints if j in arm.commanded]
        inputs = [rows.q[:, j] for j in joints or range(arm.n)]
        station = columns.posture.bearing(term.joints[0]) if term.joints else 0
        moment = np.broadcast_arrays(*columns.posture.moment(station), rows.q[:, 0])[:3]
        inputs.append(np.linalg.norm(moment, axis=0))
        along = np.concatenate([smooth_in(values)[:, :BENDS] for values in inputs], axis=1)
        along *= VARIES
        made.append(moved[..., None] * along[:, None, :])
    return fit.whitened(np.concatenate(made, axis=-1))
