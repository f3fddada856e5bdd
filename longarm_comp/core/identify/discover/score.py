"""Evidence of columns whose size is not known: Bayes factors averaged over seven amplitudes."""

from __future__ import annotations

import numpy as np

AMPLITUDES = np.array([0.15, 0.4, 1.0, 2.5, 6.0, 15.0, 40.0])
"""Prior standard deviations of the tip's rms shift, in units of the noise of a coordinate."""


def rank_one(t: np.ndarray, s: np.ndarray, size2: np.ndarray) -> np.ndarray:
    """Log evidence of single columns, all of one shape.

    Args:
        t: products of the columns with the projected residual, whitened.
        s: squares of the projected columns.
        size2: mean square shift of a row by a unit of the column, in units of the noise.
    """
    total = np.full(t.shape, -np.inf, dtype=t.dtype)
    gain, relative = t**2 / size2, s / size2
    for a2 in AMPLITUDES**2:
        grown = 1.0 + a2 * relative
        one = 0.5 * (a2 * gain / grown - np.log(grown))
        total = np.logaddexp(total, one)
    return np.asarray(total - np.log(len(AMPLITUDES)))


def many(t: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log evidence of groups of columns.

    Args:
        t: (M, r) products of scaled columns with the projected residual: a unit of a column
            shifts the rows by its decay, in units of the noise.
        s: (M, r, r) products of these columns, projected.

    Returns:
        (M,) log evidence and (M,) the amplitude at which it is highest.
    """
    values, turned = np.linalg.eigh((s + np.swapaxes(s, 1, 2)) / 2)
    values = np.maximum(values, 0.0)
    z2 = np.einsum("mri,mr->mi", turned, t) ** 2
    each = []
    for a2 in AMPLITUDES**2:
        grown = 1.0 + a2 * values
        each.append(0.5 * (a2 * z2 / grown - np.log(grown)).sum(1))
    table = np.stack(each)
    best = AMPLITUDES[np.argmax(table, axis=0)]
    return np.logaddexp.reduce(table, axis=0) - np.log(len(AMPLITUDES)), best
