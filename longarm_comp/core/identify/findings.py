"""Findings: the named effects that were found, each with its credible set of names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.effects.units import for_people
from longarm_comp.core.identify.intervals import Interval
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect, Rival
from longarm_comp.core.identify.practical import Gain
from longarm_comp.core.identify.structure import Structure


@dataclass(frozen=True)
class PartialAlias:
    """Another effect that may stand in the place of a part of a finding.

    Attributes:
        part: in words: ``part at joint 4``.
        name: canonical name of the other effect.
    """

    part: str
    name: str


@dataclass(frozen=True)
class EffectFinding:
    """One effect that the data ask for, with what they cannot tell from it.

    Attributes:
        name: canonical name of the most probable cause.
        terms: the fitted instances.
        log_bayes_factor: against leaving the effect out, geometry and rest marginalised.
        probability: that there is an effect.
        chances: (name, probability) of its causes, given that there is one, the largest first.
        alternatives: the other names of the credible set.
        runner_up: the most probable other name, in the set or not; None where none is likely.
        partial_aliases: names that may stand for one of its parts only.
        unnamed: why a cause without a name may be there instead; empty where it may not.
    """

    name: str
    terms: tuple[Term, ...]
    log_bayes_factor: float
    probability: float
    chances: tuple[tuple[str, float], ...]
    alternatives: tuple[Rival, ...]
    runner_up: Rival | None
    partial_aliases: tuple[PartialAlias, ...] = ()
    unnamed: str = ""

    @property
    def open(self) -> bool:
        """Whether it may as well be something else, or not be there in another session."""
        return bool(self.alternatives or self.unnamed) or self.probability < CREDIBLE

    @property
    def candidate(self) -> Candidate:
        """Its name and terms."""
        return Candidate(self.name, self.terms)

    @property
    def where(self) -> tuple[str, ...]:
        """Places, in order."""
        return tuple(dict.fromkeys(t.where for t in self.terms))

    @property
    def names(self) -> tuple[str, ...]:
        """The credible set: the effect and what cannot be told from it."""
        return (self.name, *(a.name for a in self.alternatives))


def findings(found: Sequence[FoundEffect]) -> tuple[EffectFinding, ...]:
    """One finding a name, strongest first, of the single effects that have one.

    Single effects of one name at several places are one finding.  Its set holds the names that may
    stand for all of them; a name that may stand for some only is a partial alias.
    """
    names = dict.fromkeys(f.name for f in found if not f.unnamed)
    made = [_finding(name, [f for f in found if f.name == name]) for name in names]
    return tuple(sorted(made, key=lambda f: -f.log_bayes_factor))


def _finding(name: str, parts: Sequence[FoundEffect]) -> EffectFinding:
    sets = [set(f.credible) for f in parts]
    every = set.intersection(*sets)
    some = set.union(*sets) - every
    size = sum(f.log_bayes_factor for f in parts)
    chances: dict[str, float] = {}
    rivals: dict[str, Rival] = {}
    for f in parts:
        for other, chance in f.names.items():
            chances[other] = chances.get(other, 0.0) + chance * f.log_bayes_factor / size
        for rival in f.rivals:
            loss = f.log_bayes_factor - rival.log_bayes_factor
            rivals.setdefault(rival.name, replace(rival, log_bayes_factor=size - loss))
    rivals = {n: replace(r, probability=chances[n]) for n, r in rivals.items()}
    ordered = sorted(rivals.values(), key=lambda r: -r.probability)
    named = [r for r in ordered if not r.unnamed]
    partial = [
        PartialAlias(f"part at {', '.join(dict.fromkeys(t.where for t in f.terms))}", other)
        for f, own in zip(parts, sets, strict=True)
        for other in sorted(own & some)
        if other in rivals and not rivals[other].unnamed
    ]
    unnamed = next((r for r in ordered if r.unnamed), None)
    other = ""
    if unnamed is not None and unnamed.name in every:
        places = ", ".join(dict.fromkeys(t.place for t in unnamed.candidate.terms))
        other = f"a function without a name explains as much ({places})"
    return EffectFinding(
        name,
        tuple(t for f in parts for t in f.terms),
        size,
        1.0 - math.prod(1.0 - f.there for f in parts),
        tuple(sorted(chances.items(), key=lambda c: -c[1])),
        tuple(r for r in named if r.name in every),
        named[0] if named else None,
        tuple(partial),
        other,
    )


_MOST = 4
"""Number of values in a sentence."""


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
        times, unit = for_people(slot.parameter.unit)
        ends = (interval.value, interval.low, interval.high)
        value, low, high = (f"{times * v:.3g}" for v in ends)
        shown = f"{value}{'' if unit == '°' else ' '}{unit} [{low}, {high}]"
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
    names, remark = " or ".join(finding.names), ""
    if finding.partial_aliases:
        part = finding.partial_aliases[0]
        remark = f"; {part.name} could stand for its {part.part}"
    if finding.unnamed:
        remark += "; or a cause without a name"
    if finding.probability < CREDIBLE:
        remark += f"; {100 * finding.probability:.0f} % probable"
    return f"{names}: {said}{other}{remark}"


def improvement(seen: Gain, commanded: Gain) -> str:
    """Before and after: as a command would have it, and as seen where that differs."""
    told = [f"{1e3 * g.before:.2f} -> {1e3 * g.after:.2f} mm" for g in (commanded, seen)]
    return told[0] if told[0] == told[1] else f"{told[0]} as commanded ({told[1]} as seen)"


def left_in_words(structure: Structure) -> str:
    """What structure is left and where it shows; empty where none is."""
    if not structure.flag:
        return ""
    size = f"{1e3 * structure.size_m:.2f} mm of "
    moved = f", as if {structure.at} moved" if structure.at else ""
    shows = structure.sign or f"depends on {', '.join(structure.inputs)}"
    return f"{'' if size.startswith('0.00') else size}structure {shows}{moved}"
