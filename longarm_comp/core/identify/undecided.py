"""Names that rest on rows in which a switch is undecided.

A joint with play rests on one side or the other.  Where its load is near the threshold, every
effect that changes the load a little can put such a row on its right side: a jump that outweighs
hundreds of quiet rows.  Such a row tells where the threshold is, not what else the arm has.  A name
that is nothing without these rows is withdrawn, and the rows are set aside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Term
from longarm_comp.core.identify.evidence import columns_at, key, marginal_without, score
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.minor import Minor, families, taken_out, worth
from longarm_comp.core.identify.search import SearchResult
from longarm_comp.core.identify.thresholds import undecided

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
