"""Files of a diagnosis: report.json for programs, report.html and plots for people."""

from longarm_comp.report.detail import (
    Correlation,
    Detail,
    Detectable,
    Input,
    Marked,
    SeenRows,
    SetSplit,
)
from longarm_comp.report.record import DiagnosisReport
from longarm_comp.report.write import write_report

__all__ = [
    "Correlation",
    "Detail",
    "Detectable",
    "DiagnosisReport",
    "Input",
    "Marked",
    "SeenRows",
    "SetSplit",
    "write_report",
]
