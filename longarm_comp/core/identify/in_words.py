"""A finding, and what it changes, in words."""

from __future__ import annotations

from collections.abc import Mapping

from longarm_comp.core.effects.units import for_people
from longarm_comp.core.identify.findings import EffectFinding
from longarm_comp.core.identify.intervals import Interval
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.practical import Gain
from longarm_comp.core.identify.structure import Structure

_MOST = 4
"""Number of values in a sentence."""
_SAME_MM = 0.005
"""Figures that differ by less read alike."""


def sentence(
    finding: EffectFinding, fit: ModelFit, intervals: Mapping[tuple[str, str, str], Interval]
) -> str:
    """What was found, where, how large, with its interval, and what else it could be.

    A parameter at its bound is no estimate and is left out.

    Args:
        finding: one effect.
        fit: the final one, which holds its terms.
        intervals: of its parameters, by effect, place and parameter.
    """
    values = []
    for slot in fit.slots:
        interval = intervals.get((*slot.owner.key, slot.parameter.name))
        if interval is None or interval.at_bound:
            continue
        shown = value_in_words(interval, slot.parameter.unit)
        values.append(f"{slot.owner.where} {slot.parameter.name} {shown}")
    readings = dict.fromkeys(t.reading for t in finding.terms if t.reading)
    if not values:
        values = [", ".join(finding.where)]
    listed = f"{', '.join(values[:_MOST])}{', ...' if len(values) > _MOST else ''}"
    said = "; ".join((listed, *readings))
    other = ""
    if finding.runner_up is not None and not finding.alternatives:
        odds = finding.log_bayes_factor - finding.runner_up.log_bayes_factor
        other = f", runner-up {finding.runner_up.candidate.name} (log odds {odds:.0f})"
    names, remark = _names(finding)
    if finding.unnamed:
        remark += "; or a cause without a name"
    return f"{names}: {said}{other}{remark}"


def value_in_words(interval: Interval, unit: str) -> str:
    """A value with its interval, in the unit that people read: ``0.61° [0.6, 0.62]``."""
    times, name = for_people(unit)
    value, low, high = (f"{times * v:.3g}" for v in (interval.value, interval.low, interval.high))
    return f"{value}{'' if name == '°' else ' '}{name} [{low}, {high}]"


def improvement(seen: Gain, commanded: Gain) -> str:
    """Before and after: as a command would have it, and as seen where that differs."""
    pairs = [(1e3 * g.before, 1e3 * g.after) for g in (commanded, seen)]
    told = [f"{before:.2f} -> {after:.2f} mm" for before, after in pairs]
    if all(abs(a - b) < _SAME_MM for a, b in zip(*pairs, strict=True)):
        return told[0]
    return f"{told[0]} as commanded ({told[1]} as seen)"


def left_in_words(structure: Structure) -> str:
    """What structure is left and where it shows; empty where none is."""
    if not structure.flag:
        return ""
    size = f"{1e3 * structure.size_m:.2f} mm of structure"
    moved = f", as if {structure.at} moved" if structure.at else ""
    shows = structure.sign or f"depends on {', '.join(structure.inputs)}"
    return f"{size if 1e3 * structure.size_m >= _SAME_MM else 'structure'} {shows}{moved}"


def _names(finding: EffectFinding) -> tuple[str, str]:
    """What a finding may be, and what else could stand for a part of it."""
    names = " or ".join(finding.names)
    if not finding.partial_aliases:
        return names, ""
    part = finding.partial_aliases[0]
    return names, f"; {part.name} could stand for its {part.part}"
