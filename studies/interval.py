"""95 % intervals: of means by resampling, of shares in closed form."""

import math

import numpy as np

DRAWN = 4000
"""Resamples: the ends move by a hundredth of the interval."""


def mean_ci95(values: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of (N,) values, and its 95 % interval: the values drawn anew (Efron 1979)."""
    drawn = np.random.default_rng(0).integers(len(values), size=(DRAWN, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), [2.5, 97.5])
    return float(values.mean()), float(low), float(high)


def wilson(share: float, count: float) -> tuple[float, float]:
    """Return the 95 % interval of a share of so many (Wilson 1927); 0 to 1 of none."""
    if count == 0:
        return 0.0, 1.0
    z = 1.96
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)
