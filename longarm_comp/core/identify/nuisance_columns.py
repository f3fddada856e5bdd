"""What an interval must allow for beside the parameters that were fitted.

Columns that are put beside those of the final fit before its data are resampled: places of a found
effect that were dropped (left out is not zero), forms on a scale that were chosen and could have
come out otherwise, and other effects that stand for a part of a finding so much better that they
may well be there instead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from longarm_comp.core.identify.aliasing import Finding
from longarm_comp.core.identify.candidates import Candidate, Columns, Term
from longarm_comp.core.identify.evidence import columns_at, key
from longarm_comp.core.identify.fit import Fit
from longarm_comp.core.identify.refine_forms import neighbours

STEP = 0.05
"""Of the width between the neighbouring tried values: step of a form's slope."""


def allowances(fit: Fit, found: Sequence[Finding], candidates: Sequence[Candidate]) -> np.ndarray:
    """(3M, k) whitened, prior-scaled columns."""
    columns = columns_at(fit)
    other = {**_dropped(fit, found, candidates), **_standing_in(found)}
    made = [columns.of(tuple(other.values()))]
    made += _slopes(fit, columns, [t for f in found for t in f.terms], candidates)
    return fit.whitened(np.concatenate(made, axis=-1))


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
    fit: Fit, columns: Columns, terms: Sequence[Term], candidates: Sequence[Candidate]
) -> list[np.ndarray]:
    """(N, 3, 1) shift of the tip as each scale moves half way to the next tried value."""
    ways: list[tuple[Term, Term, float]] = []
    for term in terms:
        for field in term.tunable:
            low, high = neighbours(term, field, candidates)
            here = float(getattr(term, field))
            step = STEP if here < 0.5 * (low + high) else -STEP
            moved = dataclasses.replace(term, **{field: here + step * (high - low)})
            ways.append((term, moved, 0.5 / step))
    columns.of([t for term, moved, _ in ways for t in (term, moved)])  # all at once: much faster
    made = []
    for term, moved, times in ways:
        values = [
            v / slot.parameter.prior
            for v, slot in zip(fit.model.values, fit.slots, strict=True)
            if key(slot.owner) == key(term)
        ]
        change = (columns.of([moved]) - columns.of([term])) @ np.array(values)
        made.append(times * change[..., None])
    return made
