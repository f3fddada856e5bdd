"""A finding as a sentence."""

from __future__ import annotations

from longarm_comp.core.identify.aliasing import EffectFinding
from longarm_comp.core.identify.confirm import Confirmed
from longarm_comp.core.identify.fit import ModelFit


def sentence(finding: EffectFinding, fit: ModelFit, confirmed: Confirmed) -> str:
    """What was found, where, how large, with its interval, and what else it could be.

    A parameter at its bound is no estimate and is left out.

    Args:
        finding: one effect.
        fit: the final one, which holds its terms.
        confirmed: intervals of the fit's parameters.
    """
    values = []
    places = {(t.name, t.where) for t in finding.terms}
    for k, slot in enumerate(fit.slots):
        if (slot.owner.name, slot.owner.where) in places:
            i = confirmed.intervals[k]
            if i.at_bound:
                continue
            p = slot.parameter
            values.append(
                f"{slot.owner.where} {p.name} {i.value:.3g} {p.unit} [{i.low:.3g}, {i.high:.3g}]"
            )
    other = ""
    if finding.runner_up is not None and not finding.alternatives:
        odds = finding.log_bayes_factor - finding.runner_up.log_bayes_factor
        other = f", runner-up {finding.runner_up.candidate.name} (log odds {odds:.0f})"
    names, remark = _names(finding)
    listed = f"{', '.join(values[:4])}{', ...' if len(values) > 4 else ''}"
    return f"{names}: {listed}{other}{remark}"


def _names(finding: EffectFinding) -> tuple[str, str]:
    """What a finding may be, and what else could stand for a part of it.

    An alias that is one parameter of the effect under another name is told with what stands for
    the other parameter: a servo that droops is a joint that gives way, with play.
    """
    names, others = " or ".join(finding.names), finding.names[1:]
    if not finding.partial_aliases:
        return names, ""
    part, term = finding.partial_aliases[0], finding.terms[0]
    parameter = part.part in {p.name for p in term.declared()}
    if parameter and others and set(others) <= set(term.aliases):
        return f"{finding.name}, or {' or '.join(others)} with {part.name} for the {part.part}", ""
    return names, f"; {part.name} could stand for its {part.part}"
