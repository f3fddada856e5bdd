"""The scene of the arm and its residual arrows: which rows, at what scale, and as data."""

from __future__ import annotations

import json

import numpy as np

from longarm_comp.report.detail import SeenRows
from longarm_comp.report.record import rounded
from longarm_comp.report.style import LOOKS

MOST = 150
"""Most arrows in one figure. Of more rows, this many are taken evenly along the session."""
_ROUND = np.array([1.0, 2.0, 5.0])


def stages_of(rows: SeenRows) -> tuple[str, ...]:
    """The stages that these rows have, in order."""
    return tuple(stage for stage in LOOKS if stage in rows.errors_m)


def points_of(rows: SeenRows) -> np.ndarray:
    """(P, 3) every measured tip and every point of the centre-lines, m."""
    return np.concatenate([rows.measured_m, *rows.arms_m])


def exaggeration(rows: SeenRows, stages: tuple[str, ...]) -> float:
    """Factor on all arrows: the largest p95 of the stages becomes about 15 % of the scene.

    It is 1, 2 or 5 times a power of ten.
    """
    lengths = [np.linalg.norm(rows.errors_m[stage], axis=1) for stage in stages]
    long = max((float(np.percentile(length, 95)) for length in lengths if len(length)), default=0.0)
    if long <= 0:
        return 1.0
    wanted = max(1.0, 0.15 * float(np.ptp(points_of(rows), axis=0).max()) / long)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * _ROUND[wanted / decade * (1 + 1e-9) >= _ROUND].max())


def arrows(rows: SeenRows) -> np.ndarray:
    """(M,) the rows that get an arrow, evenly along the session."""
    n = len(rows.index)
    return np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int))


def scene_json(rows: SeenRows) -> str:
    """What report.js draws and turns, as JSON that is safe to stand in a script element; m.

    Every stage has its arrows at a scale of its own.
    """
    taken = arrows(rows)
    stages = {
        stage: {
            "times": exaggeration(rows, (stage,)),
            "color": LOOKS[stage].color,
            "errors": rows.errors_m[stage][taken].tolist(),
        }
        for stage in stages_of(rows)
    }
    plain = {
        "arms": [line.tolist() for line in rows.arms_m],
        "rows": rows.index[taken].tolist(),
        "tips": rows.measured_m[taken].tolist(),
        "stages": stages,
    }
    # To a hundredth of a millimetre, to keep the file small
    short = rounded(plain, lambda v: round(v, 5))
    return json.dumps(short, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
