"""State of every candidate of a diagnosis, why in words, and its smallest visible size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit_columns import FitColumns, rms_shift
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.plausible import INCREDIBLE
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.posterior.offers import evidence_of_each

Label = tuple[str, str]


@dataclass(frozen=True)
class Smallest:
    """The smallest size of a candidate that would be accepted.

    Attributes:
        candidate: the hypothesis.
        log_bayes_factor: what it scores on these data.
        size: in its prior standard deviations; infinite where no size could be seen.
        shift_m: RMS shift of the tip that this size stands for, m; infinite as `size`.
    """

    candidate: Candidate
    log_bayes_factor: float
    size: float
    shift_m: float

    @property
    def visible(self) -> bool:
        """Whether a plausible size would have shown."""
        return self.size <= INCREDIBLE


def detectable(
    fit: ModelFit, candidates: Sequence[Candidate], threshold: float
) -> tuple[Smallest, ...]:
    """Of candidates on top of everything that was fitted, in the order given.

    The smallest size is the one whose expected log Bayes factor reaches the threshold, noise apart.
    With ``S = B'PB`` of the k prior-scaled columns, parameters drawn with a standard deviation
    of c priors give ``E[t'(I+S)^-1 t] = c^2 tr(S (I+S)^-1 S)``; c solves
    ``c^2 tr(S (I+S)^-1 S) / 2 - ln|I+S| / 2 = threshold``.  An effect without parameters has
    one size: it is seen or not.

    Args:
        fit: whose rows, noise and weights count.
        candidates: the hypotheses.
        threshold: log Bayes factor to reach.
    """
    columns = FitColumns(fit)
    marginal = columns.without(())
    worth = evidence_of_each(fit, marginal, candidates).tolist()
    made = []
    for candidate, factor in zip(candidates, worth, strict=True):
        free = candidate.slots(fit.model.arm)
        raw = columns.of(candidate.terms) if free else columns.shift(candidate.terms)[..., None]
        b = fit.whitened(raw)
        s = b.T @ marginal.project(b)
        values = np.clip(np.linalg.eigvalsh((s + s.T) / 2), 0.0, None)
        gain = float((values**2 / (1.0 + values)).sum())
        if not free:
            size = 1.0 if values.sum() / 2.0 >= threshold else math.inf
        elif gain > 1e-12:
            size = math.sqrt((2.0 * threshold + float(np.log1p(values).sum())) / gain)
        else:
            size = math.inf
        length = rms_shift(fit, raw)
        made.append(Smallest(candidate, factor, size, size * length if length else math.inf))
    return tuple(made)


def sizes(diagnosis: Diagnosis) -> tuple[Smallest, ...]:
    """Score and smallest visible size of the library outside the model, added to the model."""
    found = diagnosis.search
    held = {t.key for t in found.chosen}
    outside = [c for c in found.candidates if held.isdisjoint(t.key for t in c.terms)]
    return detectable(found.fit, outside, found.need)


def best_forms(tried: Sequence[Smallest]) -> dict[Label, Smallest]:
    """By effect and place, the form that scores best."""
    best: dict[Label, Smallest] = {}
    for one in tried:
        at = _label(one.candidate)
        if at not in best or one.log_bayes_factor > best[at].log_bayes_factor:
            best[at] = one
    return best


def candidate_rows(diagnosis: Diagnosis, tried: Sequence[Smallest]) -> list[dict[str, Any]]:
    """Rows of ``candidates``: one per effect and place, best first, the untestable last."""
    rows = _chosen(diagnosis)
    for at, one in best_forms(tried).items():
        state, why = _judged(diagnosis, one)
        rows[at] = _row(at, one.log_bayes_factor, state, why)
    ordered = sorted(rows.values(), key=lambda r: (-r["log_bayes_factor"], r["effect"], r["where"]))
    missing = [_row((name, "arm"), None, "not_testable", w) for name, w in diagnosis.not_testable]
    return ordered + missing


def _label(candidate: Candidate) -> Label:
    return candidate.name, ", ".join(candidate.where)


def _row(at: Label, value: float | None, state: str, why: str) -> dict[str, Any]:
    return {"effect": at[0], "where": at[1], "log_bayes_factor": value, "state": state, "why": why}


def _chosen(diagnosis: Diagnosis) -> dict[Label, dict[str, Any]]:
    """Rows of the effects that the search added, each place against the model without it."""
    result = diagnosis.search
    columns, written = FitColumns(result.fit), {t.key for t in diagnosis.model.terms}
    accepted = {}
    for term in result.chosen:
        single = Candidate(term.name, (term,))
        rest = columns.without({term.key})
        gain = float(evidence_of_each(result.fit, rest, [single])[0])
        facts = (f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in single.form)
        form = f", {', '.join(facts)}" if single.form else ""
        state, why = "accepted", f"log Bayes factor {gain:.1f} on top of the rest{form}"
        if term.key not in written:
            state, why = "rejected", f"{why}; a command is expected to err less without it"
        accepted[_label(single)] = _row(_label(single), gain, state, why)
    return accepted


def _judged(diagnosis: Diagnosis, one: Smallest) -> tuple[str, str]:
    value, need = one.log_bayes_factor, diagnosis.search.need
    alike = [f for f in diagnosis.findings if one.candidate.name in f.names[1:]]
    places = set(one.candidate.where)  # of a look-alike: one of the finding's, or none of its own
    if alike and (places & set(alike[0].where) or "arm" in places):
        return "rejected", f"these data cannot tell it from {alike[0].name}, which was added"
    if value >= need:
        return "rejected", f"log Bayes factor {value:.1f}, but the other effects already explain it"
    if one.visible:
        return "rejected", f"log Bayes factor {value:.1f}, needs {need:.1f}"
    why = "would not show at any size: the geometry explains it, or the poses do not excite it"
    if math.isfinite(one.size):
        why = (
            f"would show above {1e3 * one.shift_m:.1f} mm at the tip only, {one.size:.0f} times "
            f"its typical size (believed up to {INCREDIBLE:.0f})"
        )
    return "invisible", why
