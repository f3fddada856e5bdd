"""The interactive scene of the arm and its residual arrows, drawn by plotly."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from longarm_comp.report.detail import STAGES, SeenRows
from longarm_comp.report.record import rounded
from longarm_comp.report.style import LOOKS

MOST = 150
"""Most arrows in one figure. Of more rows, this many are taken evenly along the session."""
_ROUND = np.array([1.0, 2.0, 5.0])


def stages_of(rows: SeenRows) -> tuple[str, ...]:
    """The stages that these rows have, in order."""
    return tuple(stage for stage in STAGES if stage in rows.errors_m)


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


_ARM = "#8a8a8a"


def scene_json(rows: SeenRows, shown: str) -> str:
    """A plotly figure as JSON, safe to stand in a script element; ``shown``: the stage seen first.

    Every stage has its arrows at a scale of its own: `meta` of a trace says ``{"stage", "times"}``.
    """
    traces = [_arm_line(line) for line in rows.arms_m]
    for stage in stages_of(rows):
        traces.append(_arrow_lines(rows, stage, stage == shown))
    # To a hundredth of a millimetre, to keep the file small
    plain = rounded({"data": traces, "layout": _layout()}, lambda v: round(v, 5))
    return json.dumps(plain, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _arm_line(line: np.ndarray) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        **dict(zip("xyz", line.T.tolist(), strict=True)),
        "mode": "lines+markers",
        "line": {"color": _ARM, "width": 6},
        "marker": {"color": _ARM, "size": 3},
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _arrow_lines(rows: SeenRows, stage: str, visible: bool) -> dict[str, Any]:
    """A line for each arrow, with a dot where it starts and a gap after it."""
    times, taken = exaggeration(rows, (stage,)), arrows(rows)
    tips, errors = rows.measured_m[taken], rows.errors_m[stage][taken]
    ends = np.stack([tips, tips + times * errors], axis=1).tolist()
    points = [point for start, stop in ends for point in (start, stop, [None] * 3)]
    notes = [
        f"row {k}: ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm"
        for k, (x, y, z) in zip(rows.index[taken], 1e3 * errors, strict=True)
    ]
    color = LOOKS[stage].color
    return {
        "type": "scatter3d",
        **dict(zip("xyz", map(list, zip(*points, strict=True)), strict=True)),
        "mode": "lines+markers",
        "line": {"color": color, "width": 4},
        "marker": {"color": color, "size": [4, 0, 0] * len(notes), "line": {"width": 0}},
        "text": [entry for note in notes for entry in (note, note, "")],
        "hoverinfo": "text",
        "meta": {"stage": stage, "times": times},
        "visible": visible,
        "showlegend": False,
    }


def _layout() -> dict[str, Any]:
    def axis(name: str) -> dict[str, Any]:
        return {"title": {"text": f"{name}, m"}, "showspikes": False}

    return {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "white",
        "scene": {
            **{f"{name}axis": axis(name) for name in "xyz"},
            "aspectmode": "data",
            "camera": {
                "eye": {"x": 1.25, "y": -1.7, "z": 0.8},
                "center": {"x": 0, "y": 0, "z": -0.12},
            },
        },
    }
