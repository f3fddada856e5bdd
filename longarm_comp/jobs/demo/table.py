"""The before/after table, beside the paper's Table I."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from longarm_comp.core.identify.calibrate import Errors
from longarm_comp.jobs.loop.settings import Names
from longarm_comp.jobs.targets import Trial

ORIGINAL, DECLARED, FOUND, LEARNED = (
    "original", "declared", "effect found", "effect found + network",
)  # fmt: skip
"""Nothing compensated; the declared deflection; the diagnosed model; that and the network."""

NAMES = Names(ORIGINAL, DECLARED, FOUND, LEARNED)

_PAPER = {ORIGINAL: (17.70, 223.94), DECLARED: (15.39, 215.97), LEARNED: (9.98, 180.81)}
"""Table I, 300 samples: mean of the absolute error (mm) and its variance (mm^2)."""


def rows(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """One row a trial: what the cameras measured, what really was, what the paper has."""
    return [_row(trial) for trial in trials]


def _row(trial: Trial) -> dict[str, Any]:
    seen, true = Errors.of(trial.error), Errors.of(trial.true_error)
    mean, variance = _PAPER.get(trial.name, (None, None))
    return {
        "model": trial.name,
        "n": seen.n,
        "mean_mm": 1e3 * seen.mean,
        "rms_mm": 1e3 * seen.rms,
        "max_mm": 1e3 * seen.max,
        "mean_abs_z_mm": 1e3 * seen.mean_abs_z,
        "variance_mm2": 1e6 * seen.variance,
        "true_mean_mm": 1e3 * true.mean,
        "paper_mean_mm": mean,
        "paper_variance_mm2": variance,
    }


def improved(trials: Sequence[Trial]) -> bool:
    """Whether the last trial came nearer to the targets than the first, measured and truly."""
    first, last = trials[0], trials[-1]
    return (
        Errors.of(last.error).mean < Errors.of(first.error).mean
        and Errors.of(last.true_error).mean < Errors.of(first.true_error).mean
    )
