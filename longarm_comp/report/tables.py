"""What the tables of the page say beyond the record's own figures."""

from __future__ import annotations

import numpy as np

from longarm_comp.report.detail import Correlation
from longarm_comp.report.record import DiagnosisReport, FindingParameter, ReportCandidate

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
SIDES = {1: "all joints from below", -1: "all joints from above"}


def headline(report: DiagnosisReport) -> str:
    """The verdict in a few words: its name and what was found."""
    found = [" or ".join(finding.set or [finding.effect]) for finding in report.findings]
    verdict = report.verdict.replace("_", " ").capitalize()
    return ": ".join(filter(None, (verdict, ", ".join(found))))


def plausible(parameter: FindingParameter) -> str:
    """A value compared with its prior scale."""
    if parameter.prior_scale is None:
        return "no prior scale"
    times = abs(parameter.value) / parameter.prior_scale
    verdict = "usual" if times <= 2 else "large" if times <= 4 else "implausible"
    return f"{verdict}: {times:.1f} × prior scale"


def best_first(report: DiagnosisReport) -> list[ReportCandidate]:
    """Every candidate, those without a score last."""

    def order(entry: ReportCandidate) -> tuple[float, str, str]:
        score = entry.log_bayes_factor
        return (float("inf") if score is None else -score, entry.effect, entry.where)

    return sorted(report.candidates, key=order)


def strongest(entry: Correlation) -> list[tuple[str, str]]:
    """Per parameter, the geometry that it is most correlated with, in words."""
    lines = []
    for name, row in zip(entry.parameters, entry.matrix, strict=True):
        first = np.argsort(-np.abs(row), kind="stable")[:5]
        named = (f"{entry.geometry[k]} ({row[k]:+.2f})".replace("-", "−") for k in first)
        lines.append((name, ", ".join(named)))
    return lines
