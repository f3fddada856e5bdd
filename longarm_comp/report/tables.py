"""The tables of the page as rows of text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.report.detail import Correlation, SetSplit
from longarm_comp.report.noise_floor import ErrorFigures, NoiseFloor, noise_floor
from longarm_comp.report.record import (
    DiagnosisReport,
    FindingParameter,
    ReportCandidate,
    ReportFinding,
)
from longarm_comp.report.style import FLOOR, LOOKS
from longarm_comp.report.words import DASH, interval, number

VERDICTS = {
    "noise": "Noise",
    "named": "Named",
    "set": "Set",
    "partly": "Partly",
    "unknown": "Unknown",
    "bad_data": "Bad data",
}
STATES = {
    "accepted": "accepted",
    "rejected": "rejected",
    "not_testable": "not testable",
    "invisible": "invisible",
}


@dataclass(frozen=True)
class _ErrorLine:
    """A row of the before/after table.

    Values: mean, mean as commanded, RMS, p95, max, mean |z|, variance, excess.
    """

    label: str
    values: tuple[str, ...]
    kind: str = ""


@dataclass(frozen=True)
class _ParameterLine:
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
class _CandidateLine:
    """A candidate; `score` is for sorting, `shown` for reading."""

    effect: str
    where: str
    score: float | None
    shown: str
    state: str
    why: str


def headline(report: DiagnosisReport) -> str:
    """The verdict in a few words: its name and what was found."""
    found = [" or ".join(finding.set or [finding.effect]) for finding in report.findings]
    return ": ".join(filter(None, (VERDICTS[report.verdict], ", ".join(found))))


def error_lines(report: DiagnosisReport) -> list[_ErrorLine]:
    """The before/after table, the noise floor last.

    Without effects the line of the model with effects would repeat the calibrated one.
    """
    held = report.held_out
    marked = {held.before: "before", held.after: "after"}
    lines = [
        _ErrorLine(
            LOOKS[row.model].label,
            _mm(
                *(row.mean_mm, row.commanded_mean_mm, row.rms_mm, row.p95_mm, row.max_mm),
                *(row.mean_abs_z_mm, row.variance_mm2, row.excess_mm),
            ),
            marked.get(row.model, ""),
        )
        for row in held.rows
        if report.findings or row.model != "with_effects" or held.after == row.model
    ]
    floor = floor_of(report)
    if floor is None or not lines:
        return lines
    f = floor.figures
    values = _mm(f.mean, None, f.rms, f.p95, f.max, f.mean_abs_z, f.variance, 0.0)
    return [*lines, _ErrorLine(FLOOR + (", at most" if floor.limited else ""), values, "floor")]


def floor_of(report: DiagnosisReport) -> NoiseFloor | None:
    """The noise that the errors leave room for, mm; None where none is known."""
    held, left = report.held_out, report.structure_left
    if report.noise.sigma_mm is None or not held.n:
        return None
    rows = [
        ErrorFigures(r.mean_mm, r.rms_mm, r.p95_mm, r.max_mm, r.mean_abs_z_mm, r.variance_mm2)
        for r in held.rows
    ]
    written = "calibrated" if report.written is None else report.written.model
    used = next((r.rms_mm for r in held.rows if r.model == written), None)
    shown = left.flag and left.size_mm is not None and used is not None
    structure = (used or 0.0, left.size_mm or 0.0) if shown else None
    return noise_floor(report.noise.sigma_mm, held.n, rows, structure)


def _mm(*values: float | None) -> tuple[str, ...]:
    shown = (DASH if v is None else f"{v:.3f}" if v < 100 else f"{v:.1f}" for v in values)
    return tuple(shown)


def parameter_lines(report: DiagnosisReport) -> list[_ParameterLine]:
    """Every parameter of every finding."""
    return [
        _parameter_line(finding, parameter)
        for finding in report.findings
        for parameter in finding.parameters
    ]


def _parameter_line(finding: ReportFinding, parameter: FindingParameter) -> _ParameterLine:
    return _ParameterLine(
        finding.effect,
        parameter.name,
        parameter.where,
        number(parameter.value),
        parameter.unit,
        interval(parameter.ci95),
        _zero(parameter),
        number(parameter.prior_scale),
        _size(parameter),
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


def candidate_lines(report: DiagnosisReport) -> list[_CandidateLine]:
    """Every candidate, best score first, those without a score last."""

    def order(entry: ReportCandidate) -> tuple[float, str, str]:
        score = entry.log_bayes_factor
        return (float("inf") if score is None else -score, entry.effect, entry.where)

    return [
        _CandidateLine(
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
        first = np.argsort(-np.abs(row), kind="stable")[:5]
        named = (f"{entry.geometry[k]} ({row[k]:+.2f})".replace("-", "−") for k in first)
        lines.append((name, ", ".join(named)))
    return lines


_SIDES = {1: "all joints from below", -1: "all joints from above"}


def pose_lines(split: SetSplit) -> list[tuple[list[str], str]]:
    """The joints of every pose, and how they arrive."""
    return [
        ([f"{value:.4f}" for value in pose.q], _SIDES.get(pose.approach, "as it is"))
        for pose in split.poses
    ]
