"""The sentences of a report against its numbers, over a hundred generated diagnoses.

`make long` has 540 of them.

They are made from diagnoses (`drawn_reports`): of two simulated arms one has effects with names and
a camera that drifts, the other a set of names that its rows cannot tell apart. Others are of
measured arms, Pandas that touched sockets and DLR's Justin; these are looked at as they are, too.
"""

import dataclasses
import re
from math import sqrt
from typing import Any

import numpy as np
import pytest
from drawn_reports import drawn, in_doubt, justin, panda_3, panda_7, real
from report_pages import Page

from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.identify import diagnosis
from longarm_comp.core.identify.discover.causes import Cause, TipShift
from longarm_comp.core.identify.gains import compute_gains, measure_tip_shift
from longarm_comp.core.identify.proof import WITH_FUNCTIONS
from longarm_comp.core.identify.structure import SIGNIFICANT
from longarm_comp.report import cards, record, words
from longarm_comp.report.assemble import build_report
from longarm_comp.report.detail import Detail
from longarm_comp.report.noise_floor import floor_of
from longarm_comp.report.pages import page as rendered
from longarm_comp.report.words import DASH, open_questions


def test_the_real_one_has_findings_of_both_sides() -> None:
    names = [f.name for f in real().findings]
    assert len(names) >= 3 and "camera_drift" in names
    (soft,) = in_doubt().findings
    assert {"joint_compliance", "servo_droop"} <= set(soft.names)


def test_a_finding_in_practice_is_the_model_against_the_model_without_it() -> None:
    """The rest fitted again to first order, against a whole fit; the size as a sum by hand."""
    found, fitted = real(), real().fit
    (drift,) = (f for f in found.findings if f.name == "camera_drift")
    places = {t.key for t in drift.terms}
    fullest = [(list(fold.fits.values())[-1], fold.rows) for fold in found.folds]
    ((seen, commanded),) = compute_gains(fullest, [places])
    rate = np.array([getattr(drift.terms[0], axis) for axis in "xyz"])
    hours = fitted.session.columns["t_s"] / 3600
    tip_m = hours * np.linalg.norm(rate)
    assert measure_tip_shift(fitted, places) == pytest.approx(tip_m, rel=1e-6, abs=1e-7)
    left = []
    for kept, rows in fullest:
        bare = dataclasses.replace(kept.model, biases=())
        again = fit_model(bare, kept.session, **kept.noise_arguments)
        left.append(np.linalg.norm(compute_tip_errors(again.model, rows), axis=1))
    left = np.concatenate(left).mean()
    assert seen.before == pytest.approx(left, rel=0.02)
    assert seen.after == pytest.approx(found.proof.rows["with_effects"].mean)
    assert seen.before > 1.5 * seen.after
    assert commanded.before == pytest.approx(seen.before)
    assert commanded.after > 1.5 * seen.after


def test_what_every_arm_has_a_little_of_takes_no_findings_place() -> None:
    """Without its one finding the model is the calibration."""
    found = in_doubt()
    (soft,) = found.findings
    calibrated, written = (1e3 * found.proof.rows[n].mean for n in ("calibrated", "with_effects"))
    before, after = soft.seen_mm
    assert before == pytest.approx(calibrated, rel=0.1) and calibrated > 2.0 * written
    assert after == pytest.approx(written, rel=1e-6)


Told = tuple[record.DiagnosisReport, Page]


SETS = {
    "simulated": ((real, in_doubt), range(100)),
    "more simulated": ((real, in_doubt), range(100, 500)),
    "Pandas": ((panda_3, panda_7), range(20)),
    "Justin": ((justin,), range(20)),
}
LONG = "more simulated", "Pandas", "Justin"
SIMULATED = pytest.mark.parametrize("told", ["simulated"], indirect=True)
"""Of what is drawn from these, every case occurs."""


@pytest.fixture(
    scope="module", params=[pytest.param(s, marks=[pytest.mark.long] * (s in LONG)) for s in SETS]
)
def told(request: pytest.FixtureRequest) -> list[Told]:
    """The generated reports, and their pages without figures."""
    made_of, seeds = SETS[request.param]
    data = [request.getfixturevalue("justin_data")] if request.param == "Justin" else []
    bases = [one(*data) for one in made_of]
    rich = [base for base in bases if base.findings]
    every = [drawn(seed, rich[seed % len(rich)]) for seed in seeds if rich]
    made = []
    with pytest.MonkeyPatch.context() as patched:  # what no sentence here is about
        patched.setattr(diagnosis, "find_smallest_sizes", lambda *_: ())
        for found in (*bases, *every):
            report = build_report(found, "0" * 64)
            made.append((report, Page(rendered(report.for_people(), Detail(), {}))))
    return made


def numbers(text: str) -> list[float]:
    return [float(v) for v in re.findall(r"\d+(?:\.\d+)?", text.replace("−", "-"))]


def near(values: list[float]) -> list[Any]:
    """As they are printed: hundredths of a millimetre, from 100 mm on three digits."""
    return [pytest.approx(v, abs=6e-3 if v < 100 else 0.51) for v in values]


def named(report: record.DiagnosisReport) -> list[Any]:
    """The cards of its findings; those of causes without a name come behind."""
    return cards.cards(report.for_people())[: len(report.findings)]


def line(page: Page, tag: str) -> list[str]:
    """The row of the error table that carries a tag; empty where none does."""
    rows = [row for row in page.tables["errors"] if row[0].endswith(tag)]
    return rows[0] if rows else []


def test_the_verdict_counts_what_was_found(told: list[Told]) -> None:
    for report, page in told:
        said = words.meaning(report)
        assert said in page.words()
        n, unnamed = len(report.findings), sum(found.kept for found in report.discovered)
        if n:
            assert said.startswith(f"{words.COUNTS[n].capitalize()} physical effect")
            assert (" effects explain" in said) == (n > 1 and not (unnamed and "cause" in said))
        elif report.verdict == "partly":
            causes = f"{words.COUNTS[unnamed].capitalize()} cause{'s' * (unnamed > 1)} without"
            assert said.startswith(causes) and (" explains " in said) == (unnamed == 1)
        else:
            assert "added" in said and "effect explains" not in said
        shown = [tag for tag, attrs in page.elements if attrs.get("class") == "card"]
        assert len(shown) == n + unnamed


def test_a_cause_that_the_model_does_not_hold_explains_no_part() -> None:
    """It said: "No physical effects explain a part of what the model lacked"."""
    cause: Any = "found, and not proven"
    alone = dataclasses.replace(real(), findings=(), causes=(cause,), failed="")
    said = {
        w: dataclasses.replace(alone, written=w).verdict for w in ("with_effects", WITH_FUNCTIONS)
    }
    assert said == {"with_effects": "unknown", WITH_FUNCTIONS: "partly"}


def test_a_cause_without_a_name_has_a_card_and_is_counted(told: list[Told]) -> None:
    report = next(
        made for made, _ in told if made.verdict == "unknown" and made.structure_left.flag
    )
    cause = Cause(
        frame="joint 5",
        component="force y",
        set=("joint 5, force y", "joint 6, force y"),
        formula="joint 5, force y: (24.2 +- 0.3) N/rad^2 x q2 x q5",
        terms=(),
        ci95=(),
        domain=("q2 0..0.52 rad",),
        reading="behaves like a cable that pulls",
        title="cause without a name",
        doubts=("q2 was measured at few positions; between them it is a guess",),
        action="Look there for what it behaves like.",
        log_evidence=40.0,
        probability=0.97,
        tip_mm=TipShift(rms=1.25, max=3.75),
        held_out_rms_mm=(1.39, 0.11),
        compensated=True,
        kept=True,
    )
    row = report.held_out.rows[0]
    for gain_mm, kept in ((1.0, True), (0.3, True), (0.3, False), (1.0, False)):
        errors_mm = {"with_effects": 1.2, WITH_FUNCTIONS: 1.2 - gain_mm}
        rows = [
            row.model_copy(update={"model": m, "mean_mm": mm, "rms_mm": 9 * mm})
            for m, mm in errors_mm.items()
        ]
        held = report.held_out.model_copy(update={"rows": rows})
        quiet = report.noise.model_copy(update={"sigma_mm": None})
        causes = [cause.model_copy(update={"kept": kept}), cause]
        found = report.model_copy(update={"discovered": causes, "held_out": held, "noise": quiet})
        said, made = words.meaning(found), cards.cards(found)
        assert len(made) == 1 + kept
        worth = "Together all 2 causes without a name are" if kept else "It is"
        little = f"{worth} worth 0.30 mm, less than 0.5 mm."
        assert {card.duty for card in made} == {"Do only if" if gain_mm == 1.0 else "Leave alone"}
        assert all((card.advice == little) == (gain_mm == 0.3) for card in made)
        assert ("two causes without a name were" in said) == kept and "none was added" not in said
    (card,) = made
    assert card.title == "Cause without a name, joint 5" and card.advice.endswith(cause.action)
    assert card.tip == "1.25 mm at the tip, up to 3.75 mm"
    assert card.sure == "likely; the place is open" and "joint 6, force y" in card.because
    assert "few positions" in open_questions(found, Detail())[0][1][0]
    assert card.doubts == cause.doubts
    assert card.improves == "1.20 → 0.20 mm" and "compensates it" in card.software


def test_the_figures_of_the_first_screen_are_those_of_the_table(told: list[Told]) -> None:
    for report, page in told:
        gain = words.improvement(report)
        assert gain is not None
        before, after = line(page, "before"), line(page, "after")
        first = page.tables["errors"][1]
        assert before and after and first[0].startswith("nominal")
        assert numbers(gain["commanded"]) == near(numbers(first[2] + " " + after[2]))
        seen = gain["seen"] or gain["commanded"]
        assert numbers(seen) == near(numbers(first[1] + " " + after[1]))
        assert bool(gain["between_mm"]) == (before != first)
        assert not gain["between_mm"] or numbers(gain["between_mm"])[:1] == near(numbers(before[2]))
        shown = page.words()
        assert gain["commanded"] in shown and (gain["seen"] in shown)
        assert ("as seen and as a command would have it" in shown) == (not gain["seen"])


def test_a_given_model_is_not_called_the_arm_as_declared() -> None:
    for given, name in ((False, "the arm as declared"), (True, "the model before")):
        report = build_report(dataclasses.replace(in_doubt(), model_given=given), "0" * 64)
        assert f"from {name} to" in Page(rendered(report, Detail(), {})).words()


def test_the_sentence_has_the_figures_of_the_table(told: list[Told]) -> None:
    for report, page in told:
        if "Held-out mean error" not in report.summary:
            assert not report.findings
            continue
        tail = report.summary.split("ean error", 1)[1]
        pairs = re.findall(r"([\d.]+) -> ([\d.]+) mm", tail)
        before, after = line(page, "before"), line(page, "after")
        for pair, column in zip(pairs, (2, 1), strict=False):
            wanted = [float(before[column]), float(after[column])]
            assert [float(v) for v in pair] == near(wanted)
        assert len(pairs) == (2 if "as commanded" in tail else 1)
        differs = max(abs(float(row[1]) - float(row[2])) for row in (before, after))
        assert differs < 0.02 if len(pairs) == 1 else differs > 0.002


def test_what_is_said_of_the_gain_is_what_its_interval_says(told: list[Told]) -> None:
    for report, page in told:
        held, words = report.held_out, page.words()
        added = held.after != "calibrated"
        assert (held.before_after_ci95_mm is not None) == added
        unproven = added and held.before_after_ci95_mm[0] <= 0  # type: ignore[index]
        assert ("the gain is not proven" in words) == unproven
        if not added:
            assert "The mean falls" not in words and "is not proven" not in words
            continue
        low, high = held.commanded_ci95_mm or (0.0, 0.0)
        assert ("The mean falls by" in words) == (low > 0)
        assert ("The mean grows by" in words) == (high < 0)


def test_what_the_folds_leave_out_of_commands_is_said_where_the_model_holds_it() -> None:
    """All folds found a camera's drift; the fit of all rows explains it by the arm."""
    found = real()
    by_the_arm = {**found.fits, found.written: found.fits["calibrated"]}
    report = build_report(dataclasses.replace(found, fits=by_the_arm), "0" * 64)
    n = len(found.folds)
    assert f"camera_drift (measuring side) in {n} of {n} folds" in report.held_out.not_commanded
    gain = words.improvement(report)
    assert gain is not None and gain["camera"] and gain["expected"].endswith("mm")
    own = build_report(found, "0" * 64).held_out.not_commanded
    assert "camera_drift (measuring side)" in own and not any("folds" in said for said in own)


def test_no_line_of_the_table_is_below_the_noise(told: list[Told]) -> None:
    for _, page in told:
        rows = page.tables["errors"]
        floor = next((row for row in rows if row[0].startswith("noise floor")), None)
        if floor is None:
            assert "The errors are too small for noise of that size" in page.words()
            continue
        for row in rows[1 : rows.index(floor)]:
            for value, least in zip(row[1:8], floor[1:8], strict=True):
                assert least == DASH or float(value) >= float(least) - 1.1e-3
        assert ("at most" in floor[0]) == (
            "The estimate above holds more than noise" in page.words()
        )


@SIMULATED
def test_what_the_written_model_leaves_out_is_not_compensated(told: list[Told]) -> None:
    left_out = [r for r, _ in told if r.findings and r.written and r.written.model == "calibrated"]
    assert len(left_out) > 2
    for report in left_out:
        assert "with the model calibrated, which was written" in report.summary
        assert report.held_out.after in ("calibrated", "with_network")
        for finding, card in zip(report.findings, cards.cards(report.for_people()), strict=True):
            assert not finding.compensated and "Commands leave it out" in card.software
            assert all(p.ci95 is None for p in finding.parameters)


def test_structure_that_is_left_is_in_the_excess(told: list[Told]) -> None:
    for report, page in told:
        left, words = report.structure_left, page.words()
        assert ("Structure is left" in words) == left.flag
        assert ("No structure is left" in words) == (not left.flag and left.p_value >= SIGNIFICANT)  # type: ignore[operator]
        assert ("of the structure that was there" in words) == (left.flag and bool(report.findings))
        if left.flag:
            assert report.written is not None
            used = next(row for row in report.held_out.rows if row.model == report.written.model)
            size = left.size_mm or 0.0
            assert used.excess_mm >= min(size, used.rms_mm) - 1e-9
            assert left.text in words and left.text[:4] in report.summary


def test_cards_say_what_their_numbers_say(told: list[Told]) -> None:
    for report, page in told:
        for finding, card in zip(report.findings, named(report), strict=True):
            assert finding.action and card.title and card.improves in page.words()
            assert finding.commanded_mm is not None and finding.tip_mm is not None
            assert numbers(card.improves)[:2] == pytest.approx(finding.commanded_mm, abs=6e-3)
            assert ("no gain for commands" in card.improves) == (
                finding.commanded_mm[1] >= 0.95 * finding.commanded_mm[0]
            )
            assert numbers(card.tip)[0] == pytest.approx(finding.tip_mm.median, abs=6e-3)
            assert ("the name is open" in card.sure) == (len(finding.names) > 1)
            assert card.sure.startswith("certain") == (finding.probability >= 0.999)
            assert ("compensates it" in card.software) == finding.compensated


def test_what_is_to_do_follows_from_the_numbers(told: list[Told]) -> None:
    """Done is what is certain, above the noise and worth it; nothing in doubt is dismantled."""
    for report, page in told:
        noise = np.linalg.norm(report.noise.sigma_mm or 0.0)
        listed = cards.to_do(cards.cards(report.for_people()))
        assert sum(map(len, listed.values())) == len(cards.cards(report))
        for finding, card in zip(report.findings, named(report), strict=True):
            assert finding.seen_mm is not None
            gain = finding.seen_mm[0] - finding.seen_mm[1]
            doubt = finding.name_open or finding.doubts or finding.probability < 0.999
            worth = gain >= max(0.5, noise)
            wanted = ("Do only if" if doubt else "Do") if worth else "Leave alone"
            assert card.duty == wanted and card in listed[wanted]
            assert (finding.action in card.advice) == worth
            assert card.advice in page.words()
            if wanted != "Do only if":
                assert numbers(card.advice)[0] == pytest.approx(max(gain, 0.0), abs=6e-3)


@SIMULATED
def test_each_duty_occurs(told: list[Told]) -> None:
    assert {c.duty for report, _ in told for c in cards.cards(report)} == set(cards.DUTIES)


def test_joints_are_called_by_their_names(told: list[Told]) -> None:
    for report, page in told:
        if report.called:
            assert not re.search(r"\b(joint|row|frame) \d", page.words())
            assert any(name in page.words() for name in report.called.values())


def test_nothing_is_left_blank(told: list[Told]) -> None:
    for report, page in told:
        for text in (report.summary, page.words()):
            assert not re.search(r": ,|: \.|\bnan\b|\bNone\b|\(\)|  +|0\.00 mm of structure", text)
        for row in page.tables["errors"][1:]:
            assert all(row)
        excess = [row.excess_mm for row in report.held_out.rows]
        assert all(e <= r.rms_mm + 1e-9 for e, r in zip(excess, report.held_out.rows, strict=True))


@SIMULATED
def test_the_floor_leaves_room_for_structure(told: list[Told]) -> None:
    """Noise and structure add up to no more than the RMS of the model that leaves it."""
    shown = 0
    for report, _ in told:
        floor, left = floor_of(report), report.structure_left
        if floor is not None and left.flag:
            assert report.written is not None
            used = next(row for row in report.held_out.rows if row.model == report.written.model)
            together = sqrt(floor.figures["rms_mm"] ** 2 + (left.size_mm or 0.0) ** 2)
            assert together <= used.rms_mm + 1e-9
            shown += floor.limited
    assert shown > 5
