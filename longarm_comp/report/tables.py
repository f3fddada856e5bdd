"""The tables of the page as rows of text."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy import stats

from longarm_comp.report.arrows import stages_of
from longarm_comp.report.detail import Correlation, Detail, SetSplit, SplitPose
from longarm_comp.report.record import (
    DiagnosisReport,
    FindingParameter,
    ReportCandidate,
    ReportFinding,
    ReportNoise,
)
from longarm_comp.report.style import FLOOR, LOOKS

DASH = "–"
_STRONGEST = 5
_CERTAIN = 100
"""Power of ten above which odds are given only as a bound."""

VERDICTS = {
    "noise": ("Noise", "Nothing beyond the noise was found; nothing was added."),
    "named": ("Named", "One physical effect explains what the model lacked."),
    "set": ("Set", "Several effects explain the data about as well; more poses may split them."),
    "partly": ("Partly", "A named effect explains a part; structure is left over."),
    "unknown": ("Unknown", "There is structure, but no effect of the library explains it."),
    "bad_data": ("Bad data", "The data were refused; nothing was fitted, nothing was added."),
}
STATES = {
    "accepted": "accepted",
    "rejected": "rejected",
    "not_testable": "not testable",
    "invisible": "invisible",
}


@dataclass(frozen=True)
class ErrorLine:
    """A row of the before/after table: mean, RMS, p95, max, mean |z|, variance, excess."""

    label: str
    values: tuple[str, ...]
    kind: str = ""


@dataclass(frozen=True)
class ParameterLine:
    """A parameter of a finding, and whether its size is plausible."""

    effect: str
    name: str
    where: str
    value: str
    unit: str
    ci95: str
    zero: str
    prior: str
    plausible: str


@dataclass(frozen=True)
class CandidateLine:
    """A candidate; `score` is for sorting, `shown` for reading."""

    effect: str
    where: str
    score: float | None
    shown: str
    state: str
    why: str


def number(value: float | None, digits: int = 4) -> str:
    """A number for reading, a dash for None."""
    if value is None:
        return DASH
    if 1e4 <= abs(value) < 1e6:
        return f"{value:.0f}".replace("-", "−")
    if value and not 1e-3 <= abs(value) < 1e4:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·{_ten(int(exponent))}".replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def interval(pair: tuple[float, float] | None) -> str:
    """``lo to hi``, a dash for None."""
    return DASH if pair is None else f"{number(pair[0])} to {number(pair[1])}"


def headline(report: DiagnosisReport) -> str:
    """The verdict in a few words: its name and what was found."""
    found = [" or ".join(finding.set or [finding.effect]) for finding in report.findings]
    return ": ".join(filter(None, (VERDICTS[report.verdict][0], ", ".join(found))))


def error_lines(report: DiagnosisReport, detail: Detail) -> list[ErrorLine]:
    """The before/after table, the noise floor last."""
    marked = {detail.before: "before", detail.after: "after"}
    lines = [
        ErrorLine(
            LOOKS[row.model].label,
            _mm(
                *(row.mean_mm, row.rms_mm, row.p95_mm, row.max_mm),
                *(row.mean_abs_z_mm, row.variance_mm2, row.excess_mm),
            ),
            marked.get(row.model, ""),
        )
        for row in report.held_out.rows
    ]
    return lines + _floor(report.noise, report.held_out.n) if lines else []


def fitted_lines(detail: Detail) -> list[ErrorLine]:
    """The errors on the fitted rows; without excess."""
    if detail.train is None or not len(detail.train.index):
        return []
    lines = []
    for stage in stages_of(detail.train):
        error = detail.train.errors_m[stage] * 1e3
        length = np.linalg.norm(error, axis=1)
        values = (
            *(length.mean(), np.sqrt((length**2).mean()), np.percentile(length, 95)),
            *(length.max(), np.abs(error[:, 2]).mean(), error.var(axis=0).mean()),
        )
        lines.append(ErrorLine(LOOKS[stage].label, _mm(*map(float, values))))
    return lines


def _floor(noise: ReportNoise, n: int) -> list[ErrorLine]:
    """Errors of Gaussian noise alone, with the mean sigma for all axes and the median maximum."""
    if noise.sigma_mm is None or n == 0:
        return []
    variance = float(np.mean(np.square(noise.sigma_mm)))
    length = stats.chi(3, scale=sqrt(variance))
    longest = float(length.ppf(0.5 ** (1 / n)))
    values = _mm(
        *(float(length.mean()), sqrt(3 * variance), float(length.ppf(0.95)), longest),
        *(noise.sigma_mm[2] * sqrt(2 / np.pi), variance, 0.0),
    )
    return [ErrorLine(FLOOR, values, "floor")]


def _mm(*values: float) -> tuple[str, ...]:
    return tuple(f"{value:.3f}" if value < 100 else f"{value:.1f}" for value in values)


def parameter_lines(report: DiagnosisReport, detail: Detail) -> list[ParameterLine]:
    """Every parameter of every finding."""
    return [
        _parameter_line(finding, parameter, detail)
        for finding in report.findings
        for parameter in finding.parameters
    ]


def _parameter_line(
    finding: ReportFinding, parameter: FindingParameter, detail: Detail
) -> ParameterLine:
    remark = detail.plausibility.get((finding.effect, parameter.where, parameter.name))
    return ParameterLine(
        finding.effect,
        parameter.name,
        parameter.where,
        number(parameter.value),
        parameter.unit,
        interval(parameter.ci95),
        _zero(parameter),
        number(parameter.prior_scale),
        ". ".join(filter(None, (_size(parameter), remark))),
    )


def _zero(parameter: FindingParameter) -> str:
    if parameter.ci95 is None:
        return DASH
    return "no" if parameter.ci95[0] <= 0 <= parameter.ci95[1] else "yes"


def _size(parameter: FindingParameter) -> str:
    """The value compared with its prior scale."""
    if parameter.prior_scale is None:
        return "no prior scale"
    times = abs(parameter.value) / parameter.prior_scale
    verdict = "usual" if times <= 2 else "large" if times <= 4 else "implausible"
    return f"{verdict}: {times:.1f} × prior scale"


def candidate_lines(report: DiagnosisReport) -> list[CandidateLine]:
    """Every candidate, best score first, those without a score last."""

    def order(entry: ReportCandidate) -> tuple[float, str, str]:
        score = entry.log_bayes_factor
        return (float("inf") if score is None else -score, entry.effect, entry.where)

    return [
        CandidateLine(
            entry.effect,
            entry.where,
            entry.log_bayes_factor,
            DASH
            if entry.log_bayes_factor is None
            else f"{entry.log_bayes_factor:.1f}".replace("-", "−"),
            entry.state,
            entry.why,
        )
        for entry in sorted(report.candidates, key=order)
    ]


def strongest(entry: Correlation) -> list[tuple[str, str]]:
    """Per parameter, the geometry that it is most correlated with, in words."""
    lines = []
    for name, row in zip(entry.parameters, entry.matrix, strict=True):
        first = np.argsort(-np.abs(row), kind="stable")[:_STRONGEST]
        named = (f"{entry.geometry[k]} ({row[k]:+.2f})".replace("-", "−") for k in first)
        lines.append((name, ", ".join(named)))
    return lines


def odds(log_bayes_factor: float) -> str:
    """A log Bayes factor as odds."""
    power = abs(log_bayes_factor) / np.log(10)
    if power < 4:
        larger = f"{10**power:.3g}"
    elif power < _CERTAIN:
        larger = _ten(round(power))
    else:
        larger = f"more than {_ten(_CERTAIN)}"
    return f"{larger} : 1" if log_bayes_factor >= 0 else f"1 : {larger}"


def _ten(power: int) -> str:
    """A power of ten with its exponent raised."""
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def pose_lines(split: SetSplit, detail: Detail) -> list[tuple[list[str], str]]:
    """The joints of every pose, and what else to change."""
    return [([f"{value:.4f}" for value in pose.q], _besides(pose)) for pose in split.poses]


def _besides(pose: SplitPose) -> str:
    sides = {1: "all joints from below", -1: "all joints from above"}
    parts = [
        sides.get(pose.approach, ""),
        "" if pose.payload_kg is None else f"payload {number(pose.payload_kg)} kg",
        "" if pose.temperature_c is None else f"at {number(pose.temperature_c)} °C",
    ]
    return ", ".join(filter(None, parts)) or "as it is"
