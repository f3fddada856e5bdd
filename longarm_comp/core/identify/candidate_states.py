"""The state of every candidate of a diagnosis, with the reason, and its smallest visible size."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit_columns import FitColumns, rms_shift
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.plausible import INCREDIBLE
from longarm_comp.core.identify.findings import Finding, ReportPart
from longarm_comp.core.identify.posterior.explained import ExplainedSession
from longarm_comp.core.identify.posterior.offers import evidence_of_each

Label = tuple[str, str]
State = Literal["accepted", "rejected", "not_testable", "invisible"]


class TriedCandidate(ReportPart):
    """A candidate and its state in report.json.

    Attributes:
        effect, where: its name and place.
        log_bayes_factor: evidence for it beside the other effects; None if it cannot be tested.
        state: whether it is in the model to use, was rejected, or could not be tested or seen.
        why: the reason in words.
    """

    effect: str
    where: str
    log_bayes_factor: float | None
    state: State
    why: str


@dataclass(frozen=True)
class SmallestSize:
    """The smallest size of a candidate that would be accepted.

    Attributes:
        log_bayes_factor: evidence for it in these data.
        size: smallest size in prior standard deviations; infinite if no size could be seen.
        shift_m: RMS shift of the tip by an effect of this size, m; infinite if `size` is.
    """

    candidate: Candidate
    log_bayes_factor: float
    size: float
    shift_m: float


def find_smallest_sizes(
    fit: ModelFit, candidates: Sequence[Candidate], threshold: float
) -> tuple[SmallestSize, ...]:
    """Compute the smallest visible size of each candidate, beside everything that was fitted.

    At the smallest size the expected log Bayes factor, without noise, reaches the threshold.
    With ``S = B'PB`` of the k prior-scaled columns, parameters drawn with a standard deviation
    of c priors give ``E[t'(I+S)^-1 t] = c^2 tr(S (I+S)^-1 S)``; c solves
    ``c^2 tr(S (I+S)^-1 S) / 2 - ln|I+S| / 2 = threshold``.  An effect without parameters has
    only one size, which is visible or not.

    Args:
        fit: the fit, with its rows, noise and weights.
        threshold: log Bayes factor to reach.

    Returns:
        One `SmallestSize` per candidate, in their order.
    """
    columns = FitColumns(fit)
    marginal = columns.marginal_without(())
    worth = evidence_of_each(fit, marginal, candidates).tolist()
    made = []
    for candidate, factor in zip(candidates, worth, strict=True):
        free = candidate.slots(fit.model.arm)
        raw = columns.prior_columns(candidate.terms)
        if not free:
            raw = columns.shift_by(candidate.terms)[..., None]
        b = fit.whiten_columns(raw)
        s = b.T @ marginal.project(b)
        values = np.clip(np.linalg.eigvalsh((s + s.T) / 2), 0.0, None)
        gain = float((values**2 / (1.0 + values)).sum())
        size = math.inf
        if free and gain > 1e-12:
            size = math.sqrt((2.0 * threshold + float(np.log1p(values).sum())) / gain)
        elif not free and values.sum() / 2.0 >= threshold:
            size = 1.0
        length = rms_shift(fit, raw)
        made.append(SmallestSize(candidate, factor, size, size * length if length else math.inf))
    return tuple(made)


def best_forms(tried: Sequence[SmallestSize]) -> dict[Label, SmallestSize]:
    """Return the form of the highest log Bayes factor, by effect and place."""
    best: dict[Label, SmallestSize] = {}
    for one in tried:
        at = one.candidate.name, ", ".join(one.candidate.where)
        if at not in best or one.log_bayes_factor > best[at].log_bayes_factor:
            best[at] = one
    return best


def judge_candidates(
    explained: ExplainedSession,
    findings: Sequence[Finding],
    written: Collection[tuple[str, str]],
    tried: Sequence[SmallestSize],
    not_testable: Sequence[tuple[str, str]],
) -> list[TriedCandidate]:
    """Judge every candidate: one record per effect and place, best first, the untestable last.

    Args:
        explained: the explained session. Each of its effects is judged, at its place, against the
            model without that effect.
        findings: the named effects that were found.
        written: keys of the terms of the model to use.
        tried: the candidates that are not in the model.
        not_testable: (effect, reason) of the candidates that could not be tested.
    """
    states: dict[Label, tuple[float, State, str]] = {}
    columns = FitColumns(explained.fit)
    for term in explained.chosen_terms:
        single = Candidate(term.name, (term,))
        rest = columns.marginal_without({term.key})
        gain = float(evidence_of_each(explained.fit, rest, [single])[0])
        facts = (f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in single.form)
        form = f", {', '.join(facts)}" if single.form else ""
        why = f"log Bayes factor {gain:.1f} on top of the rest{form}"
        state: State = "accepted"
        if term.key not in written:
            state, why = "rejected", f"{why}; a command is expected to err less without it"
        states[term.name, term.where] = gain, state, why
    for at, one in best_forms(tried).items():
        states[at] = one.log_bayes_factor, *_judge_unused(explained.needed_evidence, findings, one)
    ordered = sorted(states.items(), key=lambda item: (-item[1][0], *item[0]))
    made = [
        TriedCandidate(effect=name, where=where, log_bayes_factor=factor, state=state, why=why)
        for (name, where), (factor, state, why) in ordered
    ]
    return made + [
        TriedCandidate(
            effect=name, where="arm", log_bayes_factor=None, state="not_testable", why=why
        )
        for name, why in not_testable
    ]


def _judge_unused(need: float, findings: Sequence[Finding], one: SmallestSize) -> tuple[State, str]:
    """Return the state of a candidate that is not in the model, and the reason."""
    value = one.log_bayes_factor
    places = set(one.candidate.where)
    for found in findings:  # a name of a set acts at one of its places, or on the whole arm
        near = "arm" in places or places & set(found.where)
        if near and one.candidate.name in found.names[1:]:
            return "rejected", f"these data cannot tell it from {found.name}, which was added"
    if value >= need:
        return "rejected", f"log Bayes factor {value:.1f}, but the other effects already explain it"
    if one.size <= INCREDIBLE:
        return "rejected", f"log Bayes factor {value:.1f}, needs {need:.1f}"
    why = "would not show at any size: the geometry explains it, or the poses do not excite it"
    if math.isfinite(one.size):
        why = (
            f"would show above {1e3 * one.shift_m:.1f} mm at the tip only, {one.size:.0f} times "
            f"its typical size (believed up to {INCREDIBLE:.0f})"
        )
    return "invisible", why
