"""Residual arrows on the arm: selected rows, exaggeration, end points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.report.detail import STAGES, SeenRows

MOST = 150
"""Most arrows in one figure. Of more rows, this many are taken evenly along the session."""
_SHARE = 0.15
_ROUND = np.array([1.0, 2.0, 5.0])


@dataclass(frozen=True, eq=False)
class Arrows:
    """The errors of one stage, drawn from the measured tip.

    Attributes:
        stage: the model whose errors are drawn.
        start_m, stop_m: (M, 3) ends; an arrow is `exaggeration` times the error.
        error_m: (M, 3) as they are.
        index: (M,) row numbers in the session.
        exaggeration: 1, 2 or 5 times a power of ten.
    """

    stage: str
    start_m: np.ndarray
    stop_m: np.ndarray
    error_m: np.ndarray
    index: np.ndarray
    exaggeration: float


def stages_of(rows: SeenRows) -> tuple[str, ...]:
    """The stages that these rows have, in order."""
    return tuple(stage for stage in STAGES if stage in rows.errors_m)


def points_of(rows: SeenRows) -> np.ndarray:
    """(P, 3) every measured tip and every point of the centre-lines, m."""
    return np.concatenate([rows.measured_m, *rows.arms_m])


def extent_m(rows: SeenRows) -> float:
    """Largest side of the box around `points_of`."""
    points = points_of(rows)
    return float(np.ptp(points, axis=0).max()) if len(points) else 1.0


def exaggeration(rows: SeenRows, stages: tuple[str, ...]) -> float:
    """Factor on all arrows: the largest p95 of the stages becomes about 15 % of the scene."""
    lengths = [np.linalg.norm(rows.errors_m[stage], axis=1) for stage in stages]
    long = max((float(np.percentile(length, 95)) for length in lengths if len(length)), default=0.0)
    if long <= 0:
        return 1.0
    wanted = max(1.0, _SHARE * extent_m(rows) / long)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * _ROUND[wanted / decade * (1 + 1e-9) >= _ROUND].max())


def arrows(rows: SeenRows, stage: str, times: float) -> Arrows:
    """The arrows of a stage, drawn `times` their true length."""
    n = len(rows.index)
    taken = np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int))
    start, error = rows.measured_m[taken], rows.errors_m[stage][taken]
    return Arrows(stage, start, start + times * error, error, rows.index[taken], times)
