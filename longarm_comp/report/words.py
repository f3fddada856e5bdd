"""Words of the page: numbers, the verdict, what it changed, what the data could not tell."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from longarm_comp.core.calibration.candidates import NO_PLACE
from longarm_comp.core.data.commanded import MEASURING_SIDE
from longarm_comp.core.identify.findings import FindingParameter
from longarm_comp.report.detail import Detail
from longarm_comp.report.record import DiagnosisReport, ErrorRow

DASH = "–"
_CERTAIN = 100
"""Power of ten from which on odds are given only as a bound."""


def number(value: float | None, digits: int = 4) -> str:
    """Write a number for reading, a dash for None."""
    if value is None:
        return DASH
    if 1e4 <= abs(value) < 1e6:
        return f"{value:.0f}".replace("-", "−")
    if value and not 1e-3 <= abs(value) < 1e4:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·{_power_of_ten(int(exponent))}".replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def interval(pair: tuple[float, float] | None, digits: int = 4) -> str:
    """Write ``lo to hi``, a dash for None."""
    return DASH if pair is None else f"{number(pair[0], digits)} to {number(pair[1], digits)}"


def millimetres(value: float) -> str:
    """Write a length (mm) to a hundredth of a millimetre; to a millimetre from 100 mm on."""
    return f"{value:.2f} mm" if abs(value) < 100 else f"{value:.0f} mm"


def to_three_places(value: float | None) -> str:
    """Write a length (mm) for a table, to three decimals if below 100; a dash for None."""
    return DASH if value is None else f"{value:.3f}" if value < 100 else f"{value:.1f}"


def odds(log_bayes_factor: float) -> str:
    """Write a log Bayes factor as odds, ``20 : 1``; large ones as a power of ten."""
    power = abs(log_bayes_factor) / np.log(10)
    if power < 4:
        larger = f"{10**power:.3g}" if power < 3 else f"{10**power:.0f}"
    elif power < _CERTAIN:
        larger = _power_of_ten(round(power))
    else:
        larger = f"more than {_power_of_ten(_CERTAIN)}"
    return f"{larger} : 1" if log_bayes_factor >= 0 else f"1 : {larger}"


def _power_of_ten(power: int) -> str:
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def change(pair: tuple[float, float]) -> str:
    """Write how a length (mm) changed: ``7.72 → 0.49 mm``."""
    return f"{millimetres(pair[0]).removesuffix(' mm')} → {millimetres(pair[1])}"


def join_names(names: Sequence[str]) -> str:
    """Write ``a, b or c``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


COLUMNS = {
    "mean_mm": "mean",
    "commanded_mean_mm": "as commanded",
    "rms_mm": "RMS",
    "p95_mm": "p95",
    "max_mm": "max",
    "mean_abs_z_mm": "mean |z|",
    "variance_mm2": "variance",
    "excess_mm": "excess",
}
"""Figures of an error row, and what the page calls them."""


def headline(report: DiagnosisReport) -> str:
    """Say the verdict in a few words: its name and what was found."""
    found = [" or ".join(finding.names) for finding in report.findings]
    verdict = report.verdict.replace("_", " ").capitalize()
    return ": ".join(filter(None, (verdict, ", ".join(found))))


def plausible(parameter: FindingParameter) -> str:
    """Say how the value of a parameter compares with its prior scale."""
    if parameter.prior_scale is None:
        return "no prior scale"
    times = abs(parameter.value) / parameter.prior_scale
    verdict = "usual" if times <= 2 else "large" if times <= 4 else "implausible"
    return f"{verdict}: {times:.1f} × prior scale"


STAGES = {
    "nominal": "the arm as declared",
    "frames_only": "base and marker placed",
    "calibrated": "the calibrated geometry",
    "with_effects": "the geometry with the effects found",
    "with_functions": "the model with what was found without a name",
    "with_network": "the model with the network",
}
"""What the page calls a stage; where a model was given, `nominal` is that model."""
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def meaning(report: DiagnosisReport) -> str:
    """Say what the verdict means, and how many rows it does not hold for."""
    text, aside = _describe_verdict(report), report.set_aside
    if aside is None or not aside.rows:
        return text
    were = "row was" if aside.rows == 1 else "rows were"
    return f"{text} {aside.rows} {were} set aside ({aside.share:.1%}), and not explained."


def _describe_verdict(report: DiagnosisReport) -> str:
    n, open_ = len(report.findings), sum(f.name_open for f in report.findings)
    left, unnamed = report.structure_left, sum(found.kept for found in report.discovered)
    explain = _count_of(n, "physical effect") + (" explains" if n == 1 else " explain")
    causes = _count_of(unnamed, "cause") + " without a name"
    added = f"{causes.lower()} {'was' if unnamed == 1 else 'were'} found and added"
    if not unnamed:
        added = "none was added"
    part = explain
    if unnamed and n:
        part = f"{_count_of(n, 'physical effect')} and {causes.lower()} explain"
    elif unnamed:
        part = f"{causes} explain{'s' * (unnamed == 1)}"
    of = f"{_spell_count(open_).lower()} of them"
    if open_ == n:
        of = "it" if n == 1 else "each of them"
    noise = "Nothing beyond the noise was found; nothing was added."
    if report.written is not None and report.written.model == "with_effects" and not n:
        noise = "Every part of the arm is a little off, which was added; only noise is left."
    return {
        "noise": noise,
        "named": f"{explain} what the model lacked.",
        "set": f"{explain} what the model lacked; {of} may have another name, and more poses may "
        "tell.",
        "partly": f"{part} a part of what the model lacked; "
        + ("structure is left." if left.flag else "too many names could explain the rest."),
        "unknown": f"There is structure that no effect of the library explains; {added}."
        if left.flag
        else f"Effects were found in the fitted poses, but not proven at other poses; {added}.",
        "bad_data": "The data were refused; nothing was fitted, nothing was added.",
    }[report.verdict]


def _spell_count(n: int) -> str:
    return (COUNTS[n] if n < len(COUNTS) else str(n)).capitalize()


def _count_of(n: int, what: str) -> str:
    return f"{_spell_count(n)} {what}{'' if n == 1 else 's'}"


def improvement(report: DiagnosisReport) -> dict[str, Any] | None:
    """Return texts on the mean held-out error, from the first stage to the verdict's last one.

    Returns:
        None without these rows; otherwise the texts by name:

        stages: names of the two stages; the first is the model before.
        commanded: the two errors as a command would have them.
        seen: the two errors as seen; "" if they read the same.
        between_mm: the error of the stage from which findings are counted; "" if it is the first.
        proof: what the interval of the change says.
        between: what a command leaves out, if `seen` differs.
        camera: whether a finding is on the measuring side.
        expected: the mean error that a command may expect.
    """
    held = report.held_out
    rows = {row.model: row for row in held.rows}
    if held.before not in rows or held.after not in rows:
        return None
    before, after = rows[held.before], rows[held.after]
    first = rows.get("nominal", before)
    seen = change((first.mean_mm, after.mean_mm))

    def as_commanded(row: ErrorRow) -> float:
        return row.mean_mm if row.commanded_mean_mm is None else row.commanded_mean_mm

    commanded = change((as_commanded(first), as_commanded(after)))
    called = dict(STAGES)
    if report.provenance.model_given:
        called["nominal"] = "the model before"
    between = f"{millimetres(as_commanded(before))} with {called[before.model]}"
    differs = commanded != seen
    pair, proof = held.commanded_ci95_mm or held.before_after_ci95_mm, ""
    if pair is not None:
        rise = interval((-pair[1], -pair[0]), 3)
        proof = f"The change of the mean, {rise} mm (95 %), is not proven."
        if pair[0] > 0:
            proof = f"The mean falls by {interval(pair, 3)} mm (95 %)."
        elif pair[1] < 0:
            proof = f"The mean grows by {rise} mm (95 %)."
    camera = any(MEASURING_SIDE in said for said in held.not_commanded)
    expected = {} if report.written is None else report.written.expected_commanded_mm
    return {
        "stages": (called[first.model], called[after.model]),
        "commanded": commanded,
        "seen": seen if differs else "",
        "between_mm": "" if before is first else between,
        "proof": proof,
        "between": held.not_commanded if differs else [],
        "camera": camera and bool(report.findings),
        "expected": millimetres(expected[held.after]) if held.after in expected else "",
    }


def open_questions(report: DiagnosisReport, detail: Detail) -> list[tuple[str, tuple[str, ...]]]:
    """List the questions that these data leave open, each with its details."""
    made: list[tuple[str, tuple[str, ...]]] = []
    for split in detail.splits:
        said = f"Whether it is {join_names(split.members)}"
        figure = f"expected odds {odds(split.expected_log_bayes_factor)}"
        would = f": {split.poses} poses in next_poses.csv would tell ({figure})."
        made.append((said + (would if split.poses else f". {split.reason}"), ()))
    sought = {split.members for split in detail.splits}
    made += [
        (f"Whether it is {join_names(f.names)}. No poses to decide it were looked for.", ())
        for f in report.findings
        if len(f.names) > 1 and f.names not in sought
    ]
    doubts = dict.fromkeys(d for found in report.discovered if found.kept for d in found.doubts)
    more = len(report.next_poses) - sum(split.poses for split in detail.splits)
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
