"""What the data of a diagnosis could not tell, and which poses would."""

from __future__ import annotations

from longarm_comp.core.identify.candidates import NO_PLACE
from longarm_comp.report.detail import Detail, SetSplit
from longarm_comp.report.record import DiagnosisReport
from longarm_comp.report.words import listed, odds


def open_questions(report: DiagnosisReport, detail: Detail) -> list[tuple[str, tuple[str, ...]]]:
    """What these data cannot tell, and the effects that it is about."""
    made: list[tuple[str, tuple[str, ...]]] = [(_split(split), ()) for split in detail.splits]
    split = {tuple(split.members) for split in detail.splits}
    made += [
        (f"Whether it is {listed(f.set)}. No poses to decide it were looked for.", ())
        for f in report.findings
        if len(f.set) > 1 and tuple(f.set) not in split
    ]
    doubts = dict.fromkeys(d for found in report.discovered if found.kept for d in found.doubts)
    more = len(report.next_poses) - sum(len(split.q) for split in detail.splits)
    if doubts:
        poses = f": {more} poses in next_poses.csv would tell" if more > 0 else ""
        made.append((f"The function without a name is in doubt{poses}:", tuple(doubts)))
    rows = report.candidates
    untested = tuple(
        f"{c.effect}: {c.why}" for c in rows if c.state == "not_testable" and c.why != NO_PLACE
    )
    if untested:
        made.append(("Not testable with this session:", untested))
    unseen = tuple(f"{c.effect}, {c.where}: {c.why}" for c in rows if c.state == "invisible")
    if unseen:
        made.append(("May exist, but would not show at its usual size:", unseen))
    return made


def _split(split: SetSplit) -> str:
    said = f"Whether it is {listed(list(split.members))}"
    if not len(split.q):
        return f"{said}. {split.reason or 'No pose of this arm tells them apart.'}"
    expected = split.expected_log_bayes_factor
    figure = "" if expected is None else f" (expected odds {odds(expected)})"
    return f"{said}: {len(split.q)} poses in next_poses.csv would tell{figure}."
