"""What the charts show: errors at rest and evidence of drift, over time."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from longarm_comp.view.state import PageState
from longarm_comp.view.words import length_mm


class Trace:
    """Keeps the last samples. A number that is not known is NaN, which leaves a gap."""

    def __init__(self) -> None:
        # Samples: a quarter of an hour at two a second
        self._rows: deque[tuple[float, float, float, float]] = deque(maxlen=1800)

    def add(self, state: PageState, now: float, clock: float) -> bool:
        """Take a sample at ``clock`` (s of the epoch); False where nothing is known."""
        row = (length_mm(state.missed(now)), length_mm(state.unpredicted(now)), state.evidence)
        if all(map(math.isnan, row)) or state.unread_s(now):
            return False
        self._rows.append((clock, *row))
        return True

    @property
    def errors(self) -> tuple[np.ndarray, ...]:
        """Time (n,), tip - target and tip - predicted (n,) mm."""
        at, missed, unpredicted, _ = self._columns()
        return at, missed, unpredicted

    @property
    def drift(self) -> tuple[np.ndarray, ...]:
        """Time (n,), evidence (n,), and the line at which it warns (n,)."""
        at, _, _, evidence = self._columns()
        return at, evidence, np.ones_like(at)

    @property
    def error_range(self) -> tuple[float, float]:
        """Of the errors' axis, mm: a chart that finds its own stumbles over NaN."""
        known = [value for row in self._rows for value in row[1:3] if not math.isnan(value)]
        return 0.0, 1.1 * max(known, default=1.0)

    @property
    def drift_range(self) -> tuple[float, float]:
        """Of the evidence's axis: the line at which it warns is always on it."""
        return 0.0, 1.1 * max([1.0, *(row[3] for row in self._rows if not math.isnan(row[3]))])

    def _columns(self) -> np.ndarray:
        return np.array(self._rows, float).reshape(-1, 4).T
