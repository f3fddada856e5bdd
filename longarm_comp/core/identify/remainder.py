"""Remainders: a weak effect may be no more than the misfit of a stronger one's form.

No real part follows its formula exactly: a stronger effect may differ from it along its joint and
its load.  A weaker name that loses most of its evidence to such differences is withdrawn, if the
rest would not be accepted, or if the differences alone explain more than the name alone.  What it
stood for stays in the residual, as structure.  That is only done where little is lost: a name that
takes much of the residual stays, since commands are better with it, whatever it stands for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, CandidateColumns, Term
from longarm_comp.core.identify.evidence import columns_at, key, marginal_without, score, shift_of
from longarm_comp.core.identify.minor import Minor, families, taken_out, worth
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.structure import smooth_in
from longarm_comp.core.model.model import slots_of

VARIES = 0.3
"""Share by which the shift of an effect may differ from its form (prior standard deviation)."""
BENDS = 3
"""Functions of a joint or a load, by order, that the difference may follow."""
WEAK = 0.2
"""Evidence of a weak name, per equation of the fitted rows: without it their squared error is two
fifths larger at most."""
SHARED = 0.5
"""Share of its evidence that a weaker name must lose to such differences."""


def without_remainders(
    result: SearchResult, say: Callable[[str], None]
) -> tuple[SearchResult, tuple[Minor, ...]]:
    """The search's result without such names, weakest first, and these."""
    return taken_out(result, _remainders, say)


def _remainders(result: SearchResult) -> Iterator[tuple[tuple[Term, ...], Minor]]:
    """Families that the form of a stronger one may stand for.

    Not one that has nothing to fit: it would have to imitate the misfit by chance.
    """
    fit, columns = result.fit, columns_at(result.fit)
    found = families(result)
    own = {}
    for name, terms in found.items():
        marginal = marginal_without(fit, columns, {key(t) for t in terms})
        own[name] = score(fit, marginal, Candidate(name, terms), columns).log_bayes_factor
    order = sorted(found, key=lambda name: own[name])
    for k, name in enumerate(order[:-1]):
        terms, places = found[name], {key(t) for t in found[name]}
        if own[name] > WEAK * len(fit.data) or not slots_of(fit.model.arm, terms):
            continue
        for stronger in order[:k:-1]:
            forms = variations(fit, columns, found[stronger])
            bent = marginal_without(fit, columns, places, forms)
            left = score(fit, bent, Candidate(name, terms), columns).log_bayes_factor
            if left >= SHARED * own[name]:
                continue
            alone = marginal_without(fit, columns, places).added(forms).log_bayes_factor
            if left < result.threshold or alone > own[name]:
                why = f"{stronger} may differ from its form instead, by {VARIES:.0%}"
                yield terms, Minor.of(terms, worth(fit, columns, terms), why)
                break


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
