"""Drivers: recorded quantities that move what is left of the errors.

It asks of every recorded column, axis by axis, whether the residual follows it: along a line, a
curve or a wave.  The scale of the noise is taken as unknown on every axis, since a noise that was
judged without the driver contains it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.identify.linear import MAD, OUTLIER

ODDS = math.log(20.0)
"""A driver must be this much (log) more probable than none after paying for the choice."""
BENDS = 4
"""Largest order of a curve."""
CYCLES = np.arange(0.5, 8.01, 0.125)
"""Waves that are tried, in cycles over the range of the column."""
FINE = 24
"""Steps to either side in which the best wave is then looked for."""
MOST = 3
"""Drivers that are looked for, each in what the ones before leave."""
FEWEST = 20
"""Rows from which on it is worth asking."""


@dataclass(frozen=True)
class Driver:
    """A recorded column that the residual follows.

    Attributes:
        column: name.
        shape: in words, of the column: ``pump_bar``, ``curve of pump_bar``, ``sin(6 pump_bar)``.
        axes: numbers of the channels that follow it, the strongest first.
        log_bayes_factor: against none, the choice of shape paid for.
        share: of the squared residual of these axes, what it explains.
        part: (N, d) what it explains, in the units of the residual.
    """

    column: str
    shape: str
    axes: tuple[int, ...]
    log_bayes_factor: float
    share: float
    part: np.ndarray


def drivers(
    residual: np.ndarray,
    columns: Mapping[str, np.ndarray],
    noise: np.ndarray | None = None,
    beside: np.ndarray | None = None,
) -> list[Driver]:
    """Columns that the residual follows, the best first, each in what the ones before leave.

    Args:
        residual: (N, d) measured - predicted, in the order of time; NaN or 0 where not measured.
        columns: by name, (N,).
        noise: (d,) what the sensor is known to scatter at least; a smaller effect is no effect.
        beside: (N, m) functions that may explain the residual too (of the joints); only what goes
            beyond them counts.
    """
    left = np.nan_to_num(_clipped(residual))
    floor = np.zeros(left.shape[1]) if noise is None else np.where(np.isfinite(noise), noise, 0.0)
    base = _Base.of(len(left), beside)
    varied = {name: np.asarray(v, float) for name, v in columns.items() if np.ptp(v) > 0}
    found: list[Driver] = []
    while varied and len(left) >= FEWEST + base.q.shape[1] and len(found) < MOST:
        best = max((_best(base, left, floor, *item) for item in varied.items()), key=_evidence)
        if best.log_bayes_factor < math.log(len(columns)) + ODDS:
            break
        found.append(best)
        del varied[best.column]
        left = left - best.part
    return found


def _evidence(driver: Driver) -> float:
    return driver.log_bayes_factor


@dataclass(frozen=True)
class _Base:
    """What explains the residual anyway: (N, m) orthonormal functions."""

    q: np.ndarray

    @classmethod
    def of(cls, rows: int, beside: np.ndarray | None) -> _Base:
        held = np.ones((rows, 1)) if beside is None else np.column_stack([np.ones(rows), beside])
        u, s, _ = np.linalg.svd(held, full_matrices=False)
        return cls(u[:, s > 1e-9 * s[0]])

    def beyond(self, values: np.ndarray) -> np.ndarray:
        return np.asarray(values - self.q @ (self.q.T @ values))


def _best(
    base: _Base, residual: np.ndarray, floor: np.ndarray, name: str, values: np.ndarray
) -> Driver:
    """The best shape of one column."""
    x = 2.0 * (values - values.min()) / np.ptp(values) - 1.0
    y = base.beyond(residual)
    tried = [(_judged(base, y, floor, x, f), label, f) for label, f in _shapes(x, name)]
    waves = [(_judged(base, y, floor, x, f, 1), c, f) for c, f in _waves(x, CYCLES)]
    cost = math.log(len(tried) + 1)
    if waves:
        centre = max(waves, key=lambda w: w[0][0])[1]
        step = CYCLES[1] - CYCLES[0]
        fine = centre + step * np.linspace(-1.0, 1.0, 2 * FINE + 1)
        waves = [(_judged(base, y, floor, x, f, 1), c, f) for c, f in _waves(x, fine)]
        judged, cycles, f = max(waves, key=lambda w: w[0][0])
        rate = 2.0 * math.pi * cycles / np.ptp(values)
        tried.append((judged, f"sin({rate:.3g} {name})", f))
    (value, axes), label, functions = max(tried, key=lambda t: t[0][0])
    part = np.zeros_like(residual)
    share = 0.0
    if axes:
        b = base.beyond(functions)
        part[:, axes] = functions @ np.linalg.lstsq(b, y[:, axes], rcond=None)[0]
        share = 1.0 - float(((y - base.beyond(part))[:, axes] ** 2).sum() / (y[:, axes] ** 2).sum())
    return Driver(name, label, axes, value - cost, share, part)


def _shapes(x: np.ndarray, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """A line, and curves of rising order; no more bends than the column has levels."""
    levels = len(np.unique(np.round(x, 3)))
    for order in range(1, min(BENDS, levels - 1) + 1):
        label = name if order == 1 else f"curve of {name}"
        yield label, np.polynomial.legendre.legvander(x, order)[:, 1:]


def _waves(x: np.ndarray, cycles: np.ndarray) -> Iterator[tuple[float, np.ndarray]]:
    """Sine and cosine; at least four levels of the column a cycle."""
    levels = len(np.unique(np.round(x, 3)))
    for number in cycles:
        if 0.25 <= number <= levels / 4:
            angle = math.pi * number * x
            yield float(number), np.column_stack([np.sin(angle), np.cos(angle)])


def _judged(
    base: _Base,
    y: np.ndarray,
    floor: np.ndarray,
    x: np.ndarray,
    functions: np.ndarray,
    more: int = 0,
) -> tuple[float, tuple[int, ...]]:
    """Log evidence of functions on the axes that follow them (BIC, scale unknown), and these axes.

    Rows that follow each other count for less where noise and column both do: the number of
    independent ones is N (1 - a b) / (1 + a b), with their correlations a, b from row to row
    (Bartlett 1935, J. R. Stat. Soc. 98).

    Args:
        base: what is there anyway.
        y: (N, d) what it leaves.
        floor: (d,) least noise.
        x: (N,) the column.
        functions: (N, k) of it.
        more: numbers that were chosen beside the k.
    """
    q, _ = np.linalg.qr(base.beyond(functions))
    left = y - q @ (q.T @ y)
    rows, size = len(y), functions.shape[1] + more
    before, after = (v + rows * floor**2 for v in ((y**2).sum(0), (left**2).sum(0)))
    along = _succession(x)
    gains = []
    for axis in range(y.shape[1]):
        if before[axis] <= 0:
            continue
        together = max(along * _succession(y[:, axis]), 0.0)
        count = rows * (1.0 - together) / (1.0 + together) - base.q.shape[1]
        ratio = math.log(max(after[axis] / before[axis], 1e-12))
        gain = -0.5 * count * ratio - 0.5 * size * math.log(rows)
        if gain > math.log(y.shape[1]):
            gains.append((gain - math.log(y.shape[1]), axis))
    gains.sort(reverse=True)
    return sum(g for g, _ in gains), tuple(axis for _, axis in gains)


def _succession(values: np.ndarray) -> float:
    """Correlation of successive rows."""
    v = values - values.mean()
    return float((v[1:] * v[:-1]).sum() / max((v**2).sum(), 1e-300))


def _clipped(residual: np.ndarray) -> np.ndarray:
    """Outliers of each axis drawn in to where they are none."""
    centre = np.nanmedian(residual, axis=0)
    robust = MAD * np.nanmedian(np.abs(residual - centre), axis=0)
    return np.clip(residual, centre - OUTLIER * robust, centre + OUTLIER * robust)
