"""A card per finding in words: what, how big, how sure, what to do; all from report.json."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from longarm_comp.core.effects.units import for_people
from longarm_comp.core.identify.discover.causes import Cause
from longarm_comp.core.identify.findings import Finding
from longarm_comp.core.identify.posterior.found import CREDIBLE
from longarm_comp.core.identify.proof import WITH_EFFECTS, WITH_FUNCTIONS
from longarm_comp.report import record
from longarm_comp.report.words import change, interval, join_names, millimetres, number, odds

CERTAIN = 0.999
"""Probability from which on something is called certain; from `CREDIBLE` on it is likely."""
MOST_SIZES = 8
WORTH_MM = 0.5
"""Gain of the mean error from which on a repair is advised, mm: shims, clamps and preloads are set
by hand to a few tenths at the tip, and software compensates what is smaller."""
DUTIES = ("Do", "Do only if", "Leave alone")


@dataclass(frozen=True)
class _Card:
    """A finding for people."""

    title: str
    where: str
    reading: str  # the effect's own description
    tip: str
    sure: str  # in a word or two
    because: str  # the figures behind `sure`
    doubts: tuple[str, ...]
    duty: str  # one of `DUTIES`
    advice: str  # why it has this duty, and what to do at the arm
    software: str  # what a command does about it
    improves: str  # held-out error without and with it
    names: str = ""  # canonical name, with those that cannot be told from it
    sizes: tuple[tuple[str, ...], ...] = ()  # the first parameters: place, name, value, interval
    more: int = 0  # number of further parameters
    figure: str = "mean error without → with it"  # that `improves` gives


def cards(report: record.DiagnosisReport, split: Collection[str] = ()) -> list[_Card]:
    """Make a card of each finding, then of each cause without a name that is in the model.

    Args:
        split: findings whose names the poses of next_poses.csv would tell apart.
    """
    unnamed = [_unnamed_card(found, report) for found in report.discovered if found.kept]
    return [_card_of(found, report, found.name in split) for found in report.findings] + unnamed


def to_do(made: Sequence[_Card]) -> dict[str, list[_Card]]:
    """Return the cards by duty, in the order of `DUTIES`; duties without a card are left out."""
    return {duty: held for duty in DUTIES if (held := [c for c in made if c.duty == duty])}


def _choose_duty(
    gain_mm: float,
    first: str,
    action: str,
    report: record.DiagnosisReport,
    what: str = "It is",
) -> tuple[str, str]:
    """Return the duty and the advice for a cause, by the gain of the held-out mean error.

    `first` says what must be known before the `action` at the arm; it may be empty.
    """
    noise = math.hypot(*(report.noise.sigma_mm or ()))
    if gain_mm < max(WORTH_MM, noise):
        least = "the noise" if noise > WORTH_MM else f"{WORTH_MM:g} mm"
        return DUTIES[2], f"{what} worth {millimetres(max(gain_mm, 0.0))}, less than {least}."
    if first:
        return DUTIES[1], f"{first} Then: {action}"
    return DUTIES[0], f"{what} worth {millimetres(gain_mm)}. {action}"


def _say_first(finding: Finding, split: bool) -> str:
    """Say what must be found out before a repair; empty if the finding is certain."""
    if len(finding.names) > 1:
        poses = "the poses of next_poses.csv show" if split else "a look at it shows"
        return f"{poses} that it is {finding.name}, not {join_names(finding.names[1:])}."
    if finding.unnamed:
        return f"a look at it shows the cause: {finding.unnamed}."
    if finding.doubts:
        return f"this is cleared up: {'; '.join(finding.doubts)}."
    return "" if finding.probability >= CERTAIN else "a second session finds it again."


def _unnamed_card(found: Cause, report: record.DiagnosisReport) -> _Card:
    others = found.where[1:]
    said = f"Odds of {odds(found.log_evidence)} for it, counting all functions that were tried."
    if others:
        said += f" Places that explain it as well: {join_names(others)}."
    held = "Within the range of the data the new model.yaml compensates it."
    # Only the gain of all of them together was measured
    mean_mm = {row.model: row.mean_mm for row in report.held_out.rows}
    without, with_all = mean_mm[WITH_EFFECTS], mean_mm[WITH_FUNCTIONS]
    all_of_them = sum(other.kept for other in report.discovered)
    what = f"Together all {all_of_them} causes without a name are" if all_of_them > 1 else "It is"
    first = "you find something there that acts like this."
    duty, advice = _choose_duty(without - with_all, first, found.action, report, what)
    return _Card(
        title=f"{(found.title or 'cause without a name').capitalize()}, {found.frame}",
        where=found.frame,
        reading=f"{found.formula}. {found.reading[:1].upper()}{found.reading[1:]}.",
        tip=_describe_tip(found.tip_mm.rms, found.tip_mm.max),
        sure=_say_sure(found.probability)
        + ("; the place is open" if others else _with_doubts(found.doubts)),
        because=said,
        doubts=found.doubts,
        duty=duty,
        advice=advice,
        software=held if found.compensated else "Commands leave it out.",
        improves=change((without, with_all)),
        figure="mean error without → with all that was found without a name",
    )


def _card_of(finding: Finding, report: record.DiagnosisReport, split: bool) -> _Card:
    title, where = finding.title or finding.name.replace("_", " "), _join_places(finding.where)
    before, after = finding.seen_mm or (0.0, 0.0)
    duty, advice = _choose_duty(before - after, _say_first(finding, split), finding.action, report)
    sizes = []
    for p in finding.parameters[:MOST_SIZES]:
        times, unit = for_people(p.unit)
        shown = f"{number(times * p.value, 3)}{'' if unit == '°' else ' '}{unit}"
        span = "" if p.ci95 is None else interval((times * p.ci95[0], times * p.ci95[1]), 3)
        sizes.append((p.where, p.name, shown, span))
    others = finding.names[1:]
    because = [f"Odds of {odds(finding.log_bayes_factor)} for it against leaving it out"]
    if others:
        because.append(f"These data do not tell it from {join_names(others)}")
    elif finding.runner_up is not None:
        margin = finding.log_bayes_factor - finding.runner_up.log_bayes_factor
        name = finding.runner_up.effect
        because.append(f"Next best: {name}, odds of {odds(margin)} for the name")
    if finding.unnamed:
        because.append(f"It may be a cause without a name: {finding.unnamed}")
    sure = _say_sure(finding.probability)
    named = _say_sure(finding.probability * finding.set_probability.get(finding.name, 1.0))
    if finding.name_open:
        sure += "; the name is open"
    else:
        sure += _with_doubts(finding.doubts) if named == sure else f"; the name is {named}"
    software = "The new model.yaml compensates it."
    if not finding.compensated:
        mine = [s for s in report.held_out.not_commanded if s.startswith(f"{finding.name} (")]
        reason = mine[0][len(finding.name) :] if mine else ""
        software = f"Commands leave it out{reason}; the software does not compensate it."
    improves = ""
    if finding.commanded_mm is not None and finding.seen_mm is not None:
        improves, seen = change(finding.commanded_mm), change(finding.seen_mm)
        if improves != seen:
            improves = f"{improves} as commanded; {seen} as seen"
        # An error that falls by a smaller share is not worth a word
        if finding.commanded_mm[1] >= 0.95 * finding.commanded_mm[0]:
            improves += ": no gain for commands on these rows"
    return _Card(
        title=title.capitalize() + (f", {where}" if where not in title else ""),
        names=" or ".join(finding.names),
        where=where,
        sizes=tuple(sizes),
        more=max(0, len(finding.parameters) - MOST_SIZES),
        reading=finding.reading,
        tip=_describe_tip(finding.tip_mm.median, finding.tip_mm.max) if finding.tip_mm else "",
        sure=sure,
        because=". ".join(because) + ".",
        doubts=finding.doubts,
        duty=duty,
        advice=advice,
        software=software,
        improves=improves,
    )


def _join_places(where: Sequence[str]) -> str:
    """Write ``joints 1, 3 and 4`` for ``joint 1``, ``joint 3``, ``joint 4``; others one by one."""
    split = [place.rsplit(" ", 1) for place in where]
    kinds = {parts[0] for parts in split}
    if len(where) < 2 or len(kinds) > 1 or any("," in p or len(p.split()) != 2 for p in where):
        return "; ".join(where)
    values = [parts[1] for parts in split]
    return f"{kinds.pop()}s {', '.join(values[:-1])} and {values[-1]}"


def _describe_tip(typical_mm: float, most_mm: float) -> str:
    typical, most = millimetres(typical_mm), millimetres(most_mm)
    return f"{typical} at the tip" + (f", up to {most}" if most != typical else "")


def _with_doubts(doubts: Sequence[str]) -> str:
    if not doubts:
        return ""
    return ", with a doubt" if len(doubts) == 1 else ", with doubts"


def _say_sure(probability: float) -> str:
    if probability >= CERTAIN:
        return "certain"
    return "likely" if probability >= CREDIBLE else "not sure"
