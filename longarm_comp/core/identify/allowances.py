"""What an interval must allow for beside the parameters that were fitted.

Columns that are put beside those of the final fit before its data are resampled: places of a found
effect that were dropped (left out is not zero), forms on a scale that were chosen and could have
come out otherwise, and other effects that stand for a part of a finding so much better that they
nearly pay for a name of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.distinguish import Finding
from longarm_comp.core.identify.evidence import columns_at, key
from longarm_comp.core.identify.fit import Fit
from longarm_comp.core.identify.sharpen import neighbours

STEP = 0.05
"""Of the width between the neighbouring tried values: step of a form's slope."""


def allowances(fit: Fit, found: Sequence[Finding], candidates: Sequence[Candidate]) -> np.ndarray:
    """(3M, k) whitened, prior-scaled columns."""
    columns = columns_at(fit)
    other = {**_dropped(fit, found, candidates), **_standing_in(found)}
    made = [fit.whitened(columns.of(tuple(other.values())))]
    for finding in found:
        for term in finding.terms:
            made += [
                fit.whitened(slope[..., None]) for slope in _slopes(fit, columns, term, candidates)
            ]
    return np.concatenate(made, axis=1)


def _dropped(
    fit: Fit, found: Sequence[Finding], candidates: Sequence[Candidate]
) -> dict[tuple[str, str], Term]:
    """A found effect's other places, in its form where there is one."""
    held = {key(t) for t in fit.model.terms}
    missing: dict[tuple[str, str], Term] = {}
    for finding in found:
        form = Candidate(finding.name, finding.terms).form
        mine = [c for c in candidates if c.name == finding.name]
        for candidate in sorted(mine, key=lambda c: c.form != form):
            missing = {key(t): t for t in candidate.terms if key(t) not in held} | missing
    return missing


def _standing_in(found: Sequence[Finding]) -> dict[tuple[str, str], Term]:
    """Effects that may well be there instead of a part of a finding."""
    rivals = [part.score.candidate for f in found for part in f.parts if part.rival]
    return {key(t): t for rival in rivals for t in rival.terms}


def _slopes(
    fit: Fit, columns: Columns, term: Term, candidates: Sequence[Candidate]
) -> list[np.ndarray]:
    """(N, 3) shift of the tip as each scale moves half way to the next tried value."""
    values = np.array(
        [
            fit.model.values[k] / slot.parameter.prior
            for k, slot in enumerate(fit.slots)
            if key(slot.owner) == key(term)
        ]
    )
    if not len(values):
        return []
    made = []
    for field in term.tunable:
        low, high = neighbours(term, field, candidates)
        here = float(getattr(term, field))
        way = STEP * (high - low) * (1.0 if here < 0.5 * (low + high) else -1.0)
        moved = dataclasses.replace(term, **{field: here + way})
        change = (columns.of([moved]) - columns.of([term])) @ values
        made.append(change * (0.5 * (high - low) / way))
    return made
