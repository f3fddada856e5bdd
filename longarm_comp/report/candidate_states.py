"""State of every candidate of a diagnosis, with the reason in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from longarm_comp.core.identify.aliasing import EffectFinding
from longarm_comp.core.identify.candidates import Candidate
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.evidence import (
    IMPLAUSIBLE,
    columns_at,
    key,
    marginal_without,
    score,
)
from longarm_comp.core.identify.minor import Minor
from longarm_comp.core.identify.search_state import ODDS
from longarm_comp.core.identify.visible_size import Smallest, detectable

Label = tuple[str, str]


def sizes(diagnosis: Diagnosis) -> tuple[Smallest, ...]:
    """Score and smallest visible size of all candidates outside the model, added to the model."""
    found = diagnosis.search
    return detectable(found.fit, [s.candidate for s in found.last], found.threshold)


def best_forms(tried: Sequence[Smallest]) -> dict[Label, Smallest]:
    """By effect and place, the form that scores best."""
    best: dict[Label, Smallest] = {}
    for one in tried:
        known = best.get(label(one.candidate))
        if known is None or one.log_bayes_factor > known.log_bayes_factor:
            best[label(one.candidate)] = one
    return best


def candidate_rows(diagnosis: Diagnosis, tried: Sequence[Smallest]) -> list[dict[str, Any]]:
    """Rows of ``candidates``: one per effect and place, best first, the untestable last."""
    rows = _chosen(diagnosis)
    first: dict[Label, float] = {}
    for scored in diagnosis.search.first:
        at = label(scored.candidate)
        first[at] = max(scored.log_bayes_factor, first.get(at, -math.inf))
    for at, one in best_forms(tried).items():
        state, why = _judged(diagnosis, one, first.get(at))
        rows[at] = _row(at, one.log_bayes_factor, state, why)
    ordered = sorted(rows.values(), key=lambda r: (-r["log_bayes_factor"], r["effect"], r["where"]))
    missing = [_row((name, "arm"), None, "not_testable", w) for name, w in diagnosis.not_testable]
    return ordered + missing


def label(candidate: Candidate) -> Label:
    """Effect and places, in words."""
    return candidate.name, ", ".join(candidate.where)


def _row(at: Label, value: float | None, state: str, why: str) -> dict[str, Any]:
    return {"effect": at[0], "where": at[1], "log_bayes_factor": value, "state": state, "why": why}


def _chosen(diagnosis: Diagnosis) -> dict[Label, dict[str, Any]]:
    """Rows of the effects that the search added, each place against the model without it."""
    result = diagnosis.search
    columns = columns_at(result.fit)
    accepted = {}
    for term in result.chosen:
        single = Candidate(term.name, (term,))
        gain = score(
            result.fit, marginal_without(result.fit, columns, {key(term)}), single, columns
        ).log_bayes_factor
        form = f", {_form(single)}" if single.form else ""
        state, why = "accepted", f"log Bayes factor {gain:.1f} on top of the rest{form}"
        if diagnosis.rolled_back:
            before, after = (
                1e3 * diagnosis.proof.rows[k].mean for k in ("calibrated", "with_effects")
            )
            state = "rejected"
            why += f"; rolled back: held-out mean error {before:.3f} -> {after:.3f} mm"
        elif diagnosis.added is not None and term.name in diagnosis.added.without:
            state = "rejected"
            why += "; what was found without a name explains its part better"
        accepted[label(single)] = _row(label(single), gain, state, why)
    return accepted


def _judged(diagnosis: Diagnosis, one: Smallest, first: float | None) -> tuple[str, str]:
    """State and reason of a candidate that is not in the model."""
    result, value = diagnosis.search, one.log_bayes_factor
    names = list(dict.fromkeys(t.name for t in result.chosen))
    need = result.threshold
    if one.candidate.name in names:
        need = math.log(sum(s.candidate.name == one.candidate.name for s in result.first)) + ODDS
    minor = next((m for m in diagnosis.minor if _gone(m, one.candidate)), None)
    if minor is not None:
        return "rejected", minor.why
    alike = [f for f in diagnosis.findings if one.candidate.name in f.names[1:]]
    if alike and _overlaps(alike[0], one.candidate):
        return "rejected", f"these data cannot tell it from {alike[0].name}, which was added"
    if first is not None and first >= result.threshold > value and names:
        by = " and ".join(names)
        return "rejected", f"explained by {by}: {first:.0f} before it was added, {value:.0f} after"
    if value >= need:
        return "rejected", f"log Bayes factor {value:.1f}, but the rest makes it superfluous"
    if not one.visible:
        return "invisible", _unseen(one)
    return "rejected", f"log Bayes factor {value:.1f}, needs {need:.1f}"


def _overlaps(found: EffectFinding, candidate: Candidate) -> bool:
    """Whether a look-alike sits at a place of the finding, or has no place of its own."""
    return bool(set(candidate.where) & set(found.where)) or "arm" in candidate.where


def _gone(minor: Minor, candidate: Candidate) -> bool:
    """Whether a candidate is an effect that was taken out again, at one of its places."""
    return candidate.name == minor.name and set(candidate.where) <= set(minor.where)


def _unseen(one: Smallest) -> str:
    if not math.isfinite(one.size):
        return "no size of it would show: geometry takes it up, or the poses do not excite it"
    return (
        f"would show above {1e3 * one.shift_m:.1f} mm at the tip only, {one.size:.0f} times its "
        f"typical size (believed up to {IMPLAUSIBLE:.0f})"
    )


def _form(candidate: Candidate) -> str:
    form: Mapping[str, object] = dict(candidate.form)
    return ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in form.items())
