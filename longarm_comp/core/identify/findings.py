"""Findings: the named effects that were found, each with its credible set of names.

A `Finding` is made from found effects. It is written to report.json, and the page and the command
line print it.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, GetPydanticSchema

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.candidates import Candidate, Term
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.units import for_people
from longarm_comp.core.identify.gains import Gain, compute_gains, measure_tip_shift
from longarm_comp.core.identify.intervals import Interval
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect, PossibleCause, keys_of
from longarm_comp.core.identify.structure import Structure
from longarm_comp.core.yaml_file import Closed

Pair = tuple[float, float]

MOST_VALUES = 4
"""Largest number of values in a sentence; report.json has all."""
UNWEIGHED = "arm.yaml declares no weight, so which part yields is not sure"
"""The doubt about an elastic finding if the loads are not known."""


class ReportPart(Closed):
    """A part of report.json."""

    # Every key is always written, so the schema requires each
    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


class FindingParameter(ReportPart):
    """A fitted parameter of a finding, in `unit`.

    `ci95` is None if the value is at its bound or not in the model to use: then it is no estimate.
    """

    name: str
    where: str
    value: float
    unit: str
    ci95: Pair | None
    prior_scale: float | None = Field(gt=0)


class RunnerUp(ReportPart):
    """The most probable other name of a finding."""

    effect: str
    log_bayes_factor: float


class TipSize(ReportPart):
    """The shift of the seen tip by a finding, mm, over the fitted rows."""

    median: float = Field(ge=0)
    max: float = Field(ge=0)


@dataclass(frozen=True)
class PartialAlias:
    """Another effect that may be true instead of a part of a finding.

    Attributes:
        part: the part in words: ``part at joint 4``.
        name: canonical name of the other effect.
    """

    part: str
    name: str


class Finding(ReportPart):
    """An effect that the data show, with the names that they cannot tell from it.

    Attributes:
        name: canonical name of the most probable cause; ``effect`` in report.json.
        title: the effect in words.
        reading: the meaning of its values in words.
        names: the credible set: `name` first, then the names that cannot be told from it; ``set``
            in report.json.
        probability: probability that the effect exists.
        set_probability: probability of each name of the set, given that the effect exists.
        unnamed: reason why a cause without a name may be true instead; empty if none may.
        where: places, in order.
        log_bayes_factor: log evidence for the effect; geometry and all other effects are
            marginalised.
        parameters: its fitted parameters.
        runner_up: the most probable other name, in the set or not; None if none is likely.
        compensated: whether commands with the model to use correct for it.
        tip_mm: its size at the tip.
        seen_mm, commanded_mm: mean held-out error, mm, without the effect (all others fitted again)
            and with it; as seen, and as a command would have it.
        doubts: doubts in words: names that may stand for one of its parts only, and `UNWEIGHED`.
        action: one sentence for a mechanic.
        parts: the found effects of which it is made; not in report.json.
        left_out: whether the model to use does not contain it; not in report.json.
    """

    name: str = Field(alias="effect")
    title: str = ""
    reading: str = ""
    names: tuple[str, ...] = Field(alias="set")
    probability: float = Field(ge=0, le=1)
    set_probability: dict[str, float]
    unnamed: str = ""
    where: tuple[str, ...]
    log_bayes_factor: float
    parameters: tuple[FindingParameter, ...]
    runner_up: RunnerUp | None
    compensated: bool
    tip_mm: TipSize | None = None
    seen_mm: Pair | None = None
    commanded_mm: Pair | None = None
    doubts: tuple[str, ...] = ()
    action: str = ""
    parts: Annotated[
        tuple[FoundEffect, ...], GetPydanticSchema(lambda _, handler: handler(Any))
    ] = Field(default=(), exclude=True, repr=False)
    left_out: bool = Field(default=False, exclude=True)

    @property
    def name_open(self) -> bool:
        """True if another name, or a cause without a name, may be the true one."""
        return len(self.names) > 1 or bool(self.unnamed)

    @property
    def open(self) -> bool:
        """True if the name is open, or if the effect exists with a probability below 95 %."""
        return self.name_open or self.probability < CREDIBLE

    @property
    def terms(self) -> tuple[Term, ...]:
        """The fitted terms of all its parts."""
        return tuple(t for f in self.parts for t in f.terms)

    @property
    def candidate(self) -> Candidate:
        """Its name and terms, as a candidate."""
        return Candidate(self.name, self.terms)

    @property
    def chances(self) -> tuple[tuple[str, float], ...]:
        """(name, probability) of each possible cause, given that there is one, likeliest first."""
        return _weigh_names(self.parts)

    @property
    def alternatives(self) -> tuple[PossibleCause, ...]:
        """The other names of the credible set, the most probable first."""
        return tuple(r for r in _list_rivals(self.parts) if r.name in self.names)

    @property
    def partial_aliases(self) -> tuple[PartialAlias, ...]:
        """Names that may stand for one of its parts only."""
        return _list_partial_aliases(self.parts)


def make_findings(
    found: Sequence[FoundEffect],
    arm: Arm,
    fit: ModelFit,
    written: ModelFit,
    intervals: Mapping[int, Interval],
    held_out: Sequence[tuple[ModelFit, Session]],
) -> tuple[Finding, ...]:
    """Make one finding of all found effects of one name, the strongest first.

    Functions without a name make none.  The set of a finding holds the names that may be true at
    all of its places. A name that may be true at some places only is a partial alias.

    Args:
        found: the found effects.
        arm: the declared arm.
        fit: the final fit of all that was found.
        written: the fit of the model to use.
        intervals: intervals of its parameters, by position in its slots.
        held_out: fits of the fullest model without some rows, and these rows.
    """
    by_name: dict[str, list[FoundEffect]] = {}
    for f in found:
        if not f.unnamed:
            by_name.setdefault(f.name, []).append(f)
    each = sorted(by_name.values(), key=lambda parts: -sum(f.log_bayes_factor for f in parts))
    known = {(*s.owner.key, s.parameter.name): intervals[k] for k, s in enumerate(written.slots)}
    in_model = {t.key for t in written.model.terms}
    weighed = not any(effect.through_others for effect in fit.model.effects)
    made = []
    for parts, (seen, commanded) in zip(
        each, compute_gains(held_out, [keys_of(parts) for parts in each]), strict=True
    ):
        places, terms = keys_of(parts), [t for f in parts for t in f.terms]
        left_out = in_model.isdisjoint(places)
        names, unnamed, runner_up = _name_finding(parts)
        doubts = [f"{p.name} could stand for its {p.part}" for p in _list_partial_aliases(parts)]
        if not weighed and any(t.elastic for t in terms):
            doubts.append(UNWEIGHED)
        tip_mm = 1e3 * measure_tip_shift(fit, places)
        finding = Finding(
            effect=names[0],
            title=terms[0].heading(),
            reading="; ".join(dict.fromkeys(t.reading for t in terms if t.reading)),
            set=names,
            probability=1.0 - math.prod(1.0 - f.presence for f in parts),
            set_probability={n: p for n, p in _weigh_names(parts) if n in names},
            unnamed=unnamed,
            where=tuple(dict.fromkeys(t.where for t in terms)),
            log_bayes_factor=sum(f.log_bayes_factor for f in parts),
            parameters=tuple(_list_parameters(fit, places, known, left_out)),
            runner_up=runner_up,
            compensated=all(t.commandable for t in terms) and not left_out,
            tip_mm=TipSize(median=float(np.median(tip_mm)), max=float(tip_mm.max())),
            seen_mm=(1e3 * seen.before, 1e3 * seen.after),
            commanded_mm=(1e3 * commanded.before, 1e3 * commanded.after),
            doubts=tuple(doubts),
            action=terms[0].advice(arm),
        )
        # Fields that are not in report.json cannot be given to its parser
        made.append(finding.model_copy(update={"parts": tuple(parts), "left_out": left_out}))
    return tuple(made)


def _name_finding(parts: Sequence[FoundEffect]) -> tuple[tuple[str, ...], str, RunnerUp | None]:
    """Return the set of names, the reason why none of them may be true, and the runner-up."""
    rivals, every = _list_rivals(parts), set.intersection(*(set(f.credible) for f in parts))
    named, other = [r for r in rivals if not r.unnamed], ""
    function = next((r for r in rivals if r.unnamed), None)
    if function is not None and function.name in every:
        places = ", ".join(dict.fromkeys(t.place for t in function.candidate.terms))
        other = f"a function without a name explains as much ({places})"
    runner = None
    if named:
        runner = RunnerUp(effect=named[0].name, log_bayes_factor=named[0].log_bayes_factor)
    return (parts[0].name, *(r.name for r in named if r.name in every)), other, runner


def _list_parameters(
    fit: ModelFit,
    places: Collection[tuple[str, str]],
    known: Mapping[tuple[str, str, str], Interval],
    left_out: bool,
) -> Iterator[FindingParameter]:
    """Yield the parameters at some places, with their known intervals by key and name."""
    for slot in fit.slots:
        if slot.owner.key in places:
            bare = Interval(slot.value, slot.value, slot.value)
            ends = known.get((*slot.owner.key, slot.parameter.name), bare)
            yield FindingParameter(
                name=slot.parameter.name,
                where=slot.owner.where,
                value=ends.value,
                unit=slot.parameter.unit,
                ci95=None if ends.at_bound or left_out else (ends.low, ends.high),
                prior_scale=slot.parameter.prior,
            )


def _weigh_names(parts: Sequence[FoundEffect]) -> tuple[tuple[str, float], ...]:
    """Return (name, probability) of all causes, likeliest first; parts count by their evidence."""
    size = sum(f.log_bayes_factor for f in parts)
    chances: dict[str, float] = {}
    for f in parts:
        for name, chance in f.names.items():
            chances[name] = chances.get(name, 0.0) + chance * f.log_bayes_factor / size
    return tuple(sorted(chances.items(), key=lambda c: -c[1]))


def _list_rivals(parts: Sequence[FoundEffect]) -> list[PossibleCause]:
    """Return the rivals of all parts, one per name, the most probable first.

    Its terms are those in the place of every part that has it, because poses that decide between
    two names must decide at all places.  So its evidence lacks what it loses at all these places.
    """
    size, chances = sum(f.log_bayes_factor for f in parts), dict(_weigh_names(parts))
    rivals: dict[str, PossibleCause] = {}
    for f in parts:
        for rival in f.rivals:
            loss = f.log_bayes_factor - rival.log_bayes_factor
            whole = replace(rival, log_bayes_factor=size, probability=chances[rival.name])
            held = rivals.setdefault(rival.name, whole)
            terms = dict.fromkeys((*held.candidate.terms, *rival.candidate.terms))
            everywhere = replace(held.candidate, terms=tuple(terms))
            left = held.log_bayes_factor - loss
            rivals[rival.name] = replace(held, candidate=everywhere, log_bayes_factor=left)
    return sorted(rivals.values(), key=lambda r: -r.probability)


def _list_partial_aliases(parts: Sequence[FoundEffect]) -> tuple[PartialAlias, ...]:
    sets = [set(f.credible) for f in parts]
    some = {name for own in sets for name in own if any(name not in other for other in sets)}
    named = {r.name for r in _list_rivals(parts) if not r.unnamed}
    return tuple(
        PartialAlias(f"part at {', '.join(dict.fromkeys(t.where for t in f.terms))}", name)
        for f, own in zip(parts, sets, strict=True)
        for name in sorted(own & some & named)
    )


def describe_finding(finding: Finding) -> str:
    """Describe a finding in words: names, places, values with intervals, runner-up, doubts."""
    values = []
    for p in finding.parameters:
        if p.ci95 is None and not finding.left_out:
            continue  # at its bound it is no estimate
        times, unit = for_people(p.unit)
        value, *ends = (f"{times * v:.3g}" for v in (p.value, *(p.ci95 or ())))
        within = f" [{', '.join(ends)}]" if ends else ""
        shown = f"{value}{'' if unit == '°' else ' '}{unit}{within}"
        values.append(f"{p.where} {p.name} {shown}")
    if not values:
        values = [", ".join(finding.where)]
    listed = f"{', '.join(values[:MOST_VALUES])}{', ...' if len(values) > MOST_VALUES else ''}"
    said = "; ".join(filter(None, (listed, finding.reading)))
    other = ""
    if finding.runner_up is not None and len(finding.names) == 1:
        odds = finding.log_bayes_factor - finding.runner_up.log_bayes_factor
        other = f", runner-up {finding.runner_up.effect} (log odds {odds:.0f})"
    names, remark = " or ".join(finding.names), ""
    if finding.doubts:
        remark = f"; {finding.doubts[0]}"
    if finding.unnamed:
        remark += "; or a cause without a name"
    if finding.probability < CREDIBLE:
        remark += f"; {100 * finding.probability:.0f} % probable"
    return f"{names}: {said}{other}{remark}"


def describe_improvement(seen: Gain, commanded: Gain) -> str:
    """Say the errors before and after, as commanded, and also as seen if these differ."""
    tip, sight = (f"{1e3 * g.before:.2f} -> {1e3 * g.after:.2f} mm" for g in (commanded, seen))
    return tip if tip == sight else f"{tip} as commanded ({sight} as seen)"


def describe_structure(structure: Structure) -> str:
    """Say how large the structure in the residual is and where it shows; "" if there is none."""
    if not structure.flag:
        return ""
    size = f"{1e3 * structure.size_m:.2f} mm of "
    moved = f", as if {structure.at} moved" if structure.at else ""
    shows = structure.sign or f"depends on {', '.join(structure.inputs)}"
    return f"{'' if size.startswith('0.00') else size}structure {shows}{moved}"
