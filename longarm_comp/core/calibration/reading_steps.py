"""Finds encoder readings that a fit predicts to within half a step.

Their remaining errors are rounding only.  At regularly spaced poses such errors repeat, and would
look like a function of the joint.
"""

import numpy as np

from longarm_comp.core.calibration.model_fit import ModelFit

SMALLEST = 1e-6
"""Smallest step (rad, m) of an encoder; smaller ones are the rounding of a file's digits."""


def find_step(readings: np.ndarray) -> float:
    """Return the largest step whose multiples are the differences of readings (M,); 0 if none.

    It is the greatest common divisor of the differences (Euclid), refined by the whole range.
    """
    apart = np.diff(np.unique(readings))
    step = 0.0
    for rest in apart.tolist():
        while rest > SMALLEST:
            step, rest = rest, abs(step - round(step / rest) * rest)
    span = float(apart.sum())
    return span / round(span / step) if step > SMALLEST else 0.0


def mark_exact_readings(fit: ModelFit) -> np.ndarray:
    """Return (N, d) True for encoder readings that a fit predicts to within half a step."""
    exact = np.zeros(fit.residual.shape, dtype=bool)
    for joint in fit.session.read_joints:
        name = f"read_q{joint + 1}"
        channel, read = fit.session.channels.index(name), fit.session.readings[name][:, 0]
        half = 0.5 * find_step(read[np.isfinite(read)]) + SMALLEST
        exact[:, channel] = np.abs(fit.residual[:, channel]) <= half
    return exact
