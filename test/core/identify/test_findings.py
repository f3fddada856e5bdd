"""Findings of single effects: one a name, with the set of what the data cannot tell from it."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from demo_rows import session_of
from discover_rows import DEMO

from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import linearise_model
from longarm_comp.core.effects.compliances import BearingTilt, JointCompliance
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.identify.candidate_states import SmallestSize, judge_candidates
from longarm_comp.core.identify.findings import Finding, make_findings
from longarm_comp.core.identify.intervals import compute_intervals
from longarm_comp.core.identify.posterior import explain
from longarm_comp.core.identify.posterior.found import FoundEffect, PossibleCause
from longarm_comp.core.identify.posterior.resampled import Resampling
from longarm_comp.core.model.model import Model

GAIN = Candidate("joint_gain", (JointGain(5, gain=0.01),))
GEAR = Candidate("gear_eccentricity", (GearEccentricity(5),))
TILT = Candidate("bearing_tilt", (BearingTilt(5),))
WAVE = Candidate("discovered", (Discovered("joint 5", "turn z", "linear(q5)", "q5 0..1"),))


def gain(joint: int, *names: tuple[str, float], factor: float = 40.0) -> FoundEffect:
    """A gain, or what else it may be; a rival's evidence is less by 2 for each in the row."""
    behind = {c.name: (c, factor - 2.0 * k) for k, c in enumerate((GEAR, TILT, WAVE), 1)}
    own = Candidate("joint_gain", (JointGain(joint, gain=0.01),)), factor
    rivals = (PossibleCause(*behind[name], p) for name, p in names)
    mine = PossibleCause(*own, 1.0 - sum(p for _, p in names))
    return FoundEffect((mine, *rivals), 0.9)


def named(found: list[FoundEffect]) -> tuple[Finding, ...]:
    """The findings of effects that a fit does not hold, so they move nothing in it."""
    fit = linearise_model(Model(DEMO, (JointZero(1),)), session_of(DEMO, 7))
    ends = compute_intervals(fit, (), ())
    return make_findings(found, DEMO, fit, fit, ends, [(fit, fit.session)])


@pytest.mark.parametrize(
    ("there", "open_"), [(0.01, False), (0.06, True), (0.9, True), (0.96, False)]
)
def test_what_is_credibly_not_there_is_not_in_doubt(there: float, open_: bool) -> None:
    gain = JointGain(2, gain=0.01)
    assert FoundEffect.of((gain,), there, 3.0).in_doubt is open_


def test_a_credible_set_is_the_smallest_with_95_percent() -> None:
    part = gain(5, ("gear_eccentricity", 0.3), ("bearing_tilt", 0.08), ("discovered", 0.04))
    assert part.credible == ("joint_gain", "gear_eccentricity", "bearing_tilt")
    assert gain(5, ("gear_eccentricity", 0.04)).credible == ("joint_gain",)
    assert gain(5, ("bearing_tilt", 0.05)).credible == ("joint_gain",)


def test_single_effects_of_one_name_are_one_finding_and_the_strongest_is_first() -> None:
    soft = FoundEffect.of((JointCompliance(3),), 0.99, 50.0)
    first, second = named([gain(2, factor=30.0), soft, gain(5, factor=40.0)])
    assert (first.name, first.where) == ("joint_gain", ("joint 2", "joint 5"))
    assert first.log_bayes_factor == 70.0
    assert first.probability == pytest.approx(1.0 - 0.1 * 0.1)
    assert (second.name, second.names, second.open) == (
        "joint_compliance",
        ("joint_compliance",),
        False,
    )
    assert second.runner_up is None


def test_a_rival_that_only_samples_show_has_the_odds_that_they_give_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The page said of one with 3 percent: log odds 0."""
    monkeypatch.setattr(Resampling, "_in_its_place", lambda self, found, effects: effects[0])
    sample = [gain(2, ("gear_eccentricity", 0.2))]
    certain = FoundEffect.of((JointGain(2, gain=0.01),), 1.0, 300.0)
    nothing: Any = None
    samples = Resampling(nothing, (), (), (certain,), nothing)
    (rival,) = samples._average_effect(certain, [certain], [sample] * 4).rivals
    assert (rival.name, rival.probability) == ("gear_eccentricity", pytest.approx(0.2))
    assert rival.log_bayes_factor == pytest.approx(300.0 - math.log(0.8 / 0.2))


def test_effects_are_compared_with_their_rivals_until_none_is_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The second comparison was the last, and what it took had no rivals: its name was certain."""
    first, second, third = (replace(gain(k), presence=0.7) for k in (1, 2, 1))
    answers = iter([((first,), True), ((second, third), True), ((), False)])
    state = SimpleNamespace(found=())
    monkeypatch.setattr(explain, "_compare_rivals", lambda search, state: (state, *next(answers)))
    search: Any = SimpleNamespace(repeat_until_best=lambda state: state)
    told: Any = state
    assert explain._replace_by_rivals(search, told) == (state, (second, third))
    assert next(answers, None) is None


def test_a_name_that_may_stand_for_all_parts_is_an_alternative() -> None:
    first = gain(2, ("gear_eccentricity", 0.5))
    own, rival = first.causes
    there = replace(rival, candidate=Candidate(GEAR.name, (GearEccentricity(2),)))
    first = replace(first, causes=(own, there))
    (found,) = named([first, gain(5, ("gear_eccentricity", 0.1))])
    assert found.names == ("joint_gain", "gear_eccentricity")
    assert found.open
    assert dict(found.chances)["gear_eccentricity"] == pytest.approx(0.3)
    assert found.chances[0][0] == "joint_gain"
    (rival,) = found.alternatives
    assert rival.candidate.where == ("joint 2", "joint 5"), "further poses decide at both places"
    assert rival.probability == pytest.approx(0.3)
    assert rival.log_bayes_factor == pytest.approx(80.0 - 2 * 2.0), "it loses at both places"
    assert found.partial_aliases == ()


def test_a_name_that_may_stand_for_one_part_only_is_a_partial_alias() -> None:
    parts = [gain(2, factor=10.0), gain(5, ("gear_eccentricity", 0.3), factor=30.0)]
    (found,) = named(parts)
    assert found.names == ("joint_gain",)
    assert not found.open
    assert [(p.part, p.name) for p in found.partial_aliases] == [
        ("part at joint 5", "gear_eccentricity")
    ]
    assert found.runner_up is not None
    assert found.runner_up.effect == GEAR.name
    assert dict(found.chances)["gear_eccentricity"] == pytest.approx(0.3 * 30.0 / 40.0)


def test_the_runner_up_is_the_most_probable_other_name() -> None:
    (found,) = named([gain(5, ("bearing_tilt", 0.3), ("gear_eccentricity", 0.2))])
    assert found.runner_up is not None
    assert found.runner_up.effect == TILT.name
    assert [a.candidate.name for a in found.alternatives] == ["bearing_tilt", "gear_eccentricity"]


def judged(worth: float) -> tuple[FoundEffect, bool]:
    """A gain, beside a gear that was fitted in its place, a bearing like the gear, a function."""
    causes = (
        PossibleCause(GAIN, 40.0, 0.4),
        PossibleCause(GEAR, 38.0, 0.2, "gear_eccentricity"),
        PossibleCause(TILT, 38.0, 0.2, "gear_eccentricity"),
        PossibleCause(WAVE, 30.0, 0.2, "discovered"),
    )
    part = FoundEffect(causes, 0.9)
    assert [r.name for r in part.fitted_rivals] == ["gear_eccentricity", "discovered"]
    return part.compare_with({"gear_eccentricity": worth})


@pytest.mark.parametrize(("worth", "other"), [(-0.5, False), (0.5, True)])
def test_a_fit_in_its_place_decides_between_an_effect_and_its_rival(
    worth: float, other: bool
) -> None:
    """The fit's odds are shared by what is like the rival; the rest keeps its share."""
    made, better = judged(worth)
    assert better is other
    assert made.name == ("gear_eccentricity" if other else "joint_gain")
    stays = 1.0 / (1.0 + math.exp(worth))
    wanted = {"joint_gain": stays * 2 / 3, "discovered": stays / 3}
    wanted |= dict.fromkeys(("gear_eccentricity", "bearing_tilt"), (1.0 - stays) / 2)
    assert made.names == pytest.approx(wanted)
    factors = {c.name: c.log_bayes_factor for c in made.causes}
    gear = 40.0 + worth
    assert factors == pytest.approx(
        {"joint_gain": 40.0, "gear_eccentricity": gear, "bearing_tilt": gear, "discovered": 30.0}
    )


def test_a_function_that_may_be_the_cause_opens_a_name_and_is_no_name() -> None:
    (found,) = named([gain(5, ("discovered", 0.3))])
    assert found.names == ("joint_gain",)
    assert found.open
    assert "joint 5, turn z, linear(q5)" in found.unnamed
    sure = replace(gain(5, ("discovered", 0.01)), presence=0.99)
    assert not named([sure])[0].open
    assert named([replace(sure, presence=0.9)])[0].open, "another session may not show it"
    assert named([sure])[0].unnamed == ""


def test_a_function_alone_is_no_finding() -> None:
    (term,) = WAVE.terms
    alone = FoundEffect.of((term,), 0.99, 40.0)
    assert named([alone]) == ()
    assert alone.unnamed
    assert alone.chance_unnamed == 1.0
    assert gain(5, ("discovered", 0.3)).chance_unnamed == pytest.approx(0.3)
    assert gain(5, ("gear_eccentricity", 0.3)).chance_unnamed == 0.0


def test_a_name_that_two_findings_may_have_is_told_of_the_one_at_its_place() -> None:
    """A gear may be the tilt at joint 5, which is stronger, or the gain at joint 2."""
    tilt = FoundEffect((PossibleCause(TILT, 50.0, 0.7), PossibleCause(GEAR, 48.0, 0.3)), 0.99)
    findings = named([gain(2, ("gear_eccentricity", 0.3)), tilt])
    blank: Any = SimpleNamespace(model=None, known_columns=({}, {}, {}))
    search: Any = SimpleNamespace(fit=blank, chosen_terms=(), needed_evidence=5.0)
    gears = [Candidate("gear_eccentricity", (GearEccentricity(k),)) for k in (2, 5, 3)]
    tried = [SmallestSize(gear, 20.0 - k, 1.0, 1e-3) for k, gear in enumerate(gears)]
    why = [one.why for one in judge_candidates(search, findings, (), tried, ())]
    assert why[0] == "these data cannot tell it from joint_gain, which was added"
    assert why[1] == "these data cannot tell it from bearing_tilt, which was added"
    assert why[2] == "log Bayes factor 18.0, but the other effects already explain it"
