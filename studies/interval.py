"""Intervals of means, by resampling."""

from __future__ import annotations

import numpy as np

DRAWN = 4000
"""Resamples: the ends move by a hundredth of the interval."""


def mean_ci95(values: np.ndarray) -> tuple[float, float, float]:
    """Mean of (N,) values, and its 95 % interval: the values drawn anew (Efron 1979)."""
    drawn = np.random.default_rng(0).integers(len(values), size=(DRAWN, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), [2.5, 97.5])
    return float(values.mean()), float(low), float(high)
