"""Words and numbers of the page: for its tables and sentences."""

from __future__ import annotations

import numpy as np

from longarm_comp.report.record import DiagnosisReport, FindingParameter

DASH = "–"
_CERTAIN = 100
"""Power of ten above which odds are given only as a bound."""


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


def interval(pair: tuple[float, float] | None, digits: int = 4) -> str:
    """``lo to hi``, a dash for None."""
    return DASH if pair is None else f"{number(pair[0], digits)} to {number(pair[1], digits)}"


def millimetres(value: float) -> str:
    """A length for reading: to a hundredth of a millimetre, or three digits if it is larger."""
    return f"{value:.2f} mm" if abs(value) < 100 else f"{value:.0f} mm"


def to_three_places(value: float | None) -> str:
    """A length in mm of a table; a dash for None."""
    return DASH if value is None else f"{value:.3f}" if value < 100 else f"{value:.1f}"


def odds(log_bayes_factor: float) -> str:
    """A log Bayes factor as odds."""
    power = abs(log_bayes_factor) / np.log(10)
    if power < 4:
        larger = f"{10**power:.3g}" if power < 3 else f"{10**power:.0f}"
    elif power < _CERTAIN:
        larger = _ten(round(power))
    else:
        larger = f"more than {_ten(_CERTAIN)}"
    return f"{larger} : 1" if log_bayes_factor >= 0 else f"1 : {larger}"


def _ten(power: int) -> str:
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def change(pair: tuple[float, float]) -> str:
    """``7.72 → 0.49 mm``."""
    return f"{millimetres(pair[0]).removesuffix(' mm')} → {millimetres(pair[1])}"


def listed(names: list[str]) -> str:
    """``a, b or c``."""
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
