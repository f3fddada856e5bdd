"""Finds encoder readings that a fit meets to within half a step; these tell nothing more of the
fit.

At poses that are spaced regularly, the error of a rounded reading repeats and looks like a function
of the joint.
"""

from __future__ import annotations

import numpy as np

from longarm_comp.core.calibration.model_fit import ModelFit

SMALLEST = 1e-6
"""Steps (rad, m) that are none: a file's digits, and less than an encoder tells."""


def find_step(readings: np.ndarray) -> float:
    """Return the largest step of which readings (M,) differ by whole numbers; 0 without one.

    It is the common divisor of the differences (Euclid), refined by the whole span.
    """
    apart = np.diff(np.unique(readings))
    step = 0.0
    for rest in apart.tolist():
        while rest > SMALLEST:
            step, rest = rest, abs(step - round(step / rest) * rest)
    span = float(apart.sum())
    return span / round(span / step) if step > SMALLEST else 0.0


def mark_exact_readings(fit: ModelFit) -> np.ndarray:
    """Return (N, d) whether a fit is within half a step of an encoder's reading."""
    exact = np.zeros(fit.residual.shape, dtype=bool)
    for joint in fit.session.read_joints:
        name = f"read_q{joint + 1}"
        channel, read = fit.session.channels.index(name), fit.session.readings[name][:, 0]
        half = 0.5 * find_step(read[np.isfinite(read)]) + SMALLEST
        exact[:, channel] = np.abs(fit.residual[:, channel]) <= half
    return exact
