"""Names that rest on rows in which a switch is undecided.

A joint with play rests on one side or the other.  Where its load is near the threshold, every
effect that changes the load a little can put such a row on its right side: a jump that outweighs
hundreds of quiet rows.  Such a row tells where the threshold is, not what else the arm has.  A name
that is nothing without these rows is withdrawn, and the rows are set aside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.evidence import (
    FitColumns,
    columns_at,
    key,
    marginal_without,
    score,
    shift_of,
)
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.minor import Minor, families, taken_out, worth
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.search import SearchResult

NEAR = 0.1
"""Share by which a threshold may differ from row to row."""
LEAST = 0.005
"""The same of its range, for thresholds near 0."""
JUMPS = 0.5
"""Share of an effect's largest shift by which such a difference moves an undecided row."""
SHARED = 0.5
"""Share of its evidence that a name must lose without such rows."""


def without_undecided(
    result: SearchResult, say: Callable[[str], None]
) -> tuple[SearchResult, tuple[Minor, ...]]:
    """The search's result without such names, and these."""
    before, columns = families(result), columns_at(result.fit)
    switched = [t for terms in before.values() for t in terms if t.scales()]
    rows = undecided(result.fit, columns, switched) & (result.fit.weights > 0)
    if len(before) < 2 or not rows.any():
        return result, ()
    aside = _set_aside(result, rows)
    own, left = _evidence(result), _evidence(aside)
    resting = {
        name
        for name, terms in before.items()
        if left[name] < min(result.threshold, SHARED * own[name])
        and not any(t.scales() for t in terms)
    }

    def doubtful(now: SearchResult) -> Iterator[tuple[tuple[Term, ...], Minor]]:
        found, evidence = families(now), _evidence(now)
        for name in sorted(resting & set(found), key=lambda each: evidence[each]):
            if evidence[name] < result.threshold:
                length = worth(now.fit, columns_at(now.fit), found[name])
                why = f"rests on {rows.sum()} rows whose load is close to a threshold; set aside"
                yield found[name], Minor.of(found[name], length, why)

    lighter, gone = taken_out(aside, doubtful, say)
    return (lighter, gone) if gone else (result, ())


def undecided(fitted: ModelFit, columns: FitColumns, terms: Sequence[Term]) -> np.ndarray:
    """(N,) whether a small change of a term's threshold moves the row to the other side."""
    rows = np.zeros(len(fitted.session), dtype=bool)
    for term in terms:
        largest = np.linalg.norm(shift_of(fitted, columns, [term]), axis=1).max()
        for field, (lower, upper) in term.scales().items():
            value = float(getattr(term, field))
            near = max(NEAR * abs(value), LEAST * (upper - lower))
            below, above = (
                shift_of(fitted, columns, [dataclasses.replace(term, **{field: float(v)})])
                for v in np.clip([value - near, value + near], lower, upper)
            )
            rows |= np.linalg.norm(above - below, axis=1) > JUMPS * largest
    return rows


def _set_aside(result: SearchResult, rows: np.ndarray) -> SearchResult:
    """The search's result, fitted again without some rows."""
    was = result.fit
    weights = np.where(rows, 0.0, was.weights)
    again = fit(was.model, was.session, sigma=was.sigma, rho=was.rho, weights=weights)
    return dataclasses.replace(result, fit=again)


def _evidence(result: SearchResult) -> dict[str, float]:
    """Log Bayes factor of each found effect beside the others."""
    fitted, columns = result.fit, columns_at(result.fit)
    return {
        name: score(
            fitted,
            marginal_without(fitted, columns, {key(t) for t in terms}),
            Candidate(name, terms),
            columns,
        ).log_bayes_factor
        for name, terms in families(result).items()
    }
