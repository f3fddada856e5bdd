"""The interactive scene of the arm and its residual arrows, drawn by plotly."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.report.detail import STAGES, SeenRows
from longarm_comp.report.record import rounded
from longarm_comp.report.style import LOOKS

MOST = 150
"""Most arrows in one figure. Of more rows, this many are taken evenly along the session."""
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


def _extent_m(rows: SeenRows) -> float:
    """Largest side of the box around `points_of`."""
    points = points_of(rows)
    return float(np.ptp(points, axis=0).max()) if len(points) else 1.0


def exaggeration(rows: SeenRows, stages: tuple[str, ...]) -> float:
    """Factor on all arrows: the largest p95 of the stages becomes about 15 % of the scene."""
    lengths = [np.linalg.norm(rows.errors_m[stage], axis=1) for stage in stages]
    long = max((float(np.percentile(length, 95)) for length in lengths if len(length)), default=0.0)
    if long <= 0:
        return 1.0
    wanted = max(1.0, 0.15 * _extent_m(rows) / long)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * _ROUND[wanted / decade * (1 + 1e-9) >= _ROUND].max())


def arrows(rows: SeenRows, stage: str, times: float) -> Arrows:
    """The arrows of a stage, drawn `times` their true length."""
    n = len(rows.index)
    taken = np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int))
    start, error = rows.measured_m[taken], rows.errors_m[stage][taken]
    return Arrows(stage, start, start + times * error, error, rows.index[taken], times)


_ARM = "#8a8a8a"
_POINTS = 10
"""Number of points of the polyline of one arrow."""


def scene_json(rows: SeenRows, shown: str) -> str:
    """A plotly figure as JSON, safe to stand in a script element.

    Every stage has its arrows twice: at a scale of its own, and at one for all stages. `meta`
    of a trace says which: ``{"stage", "scale": "own|same", "times"}``.

    Args:
        rows: what to draw.
        shown: the stage that is visible first, at its own scale.
    """
    stages = stages_of(rows)
    same = exaggeration(rows, stages)
    # Length of an arrow's head as a share of the scene
    head = 0.018 * _extent_m(rows)
    traces = [_arm_line(line) for line in rows.arms_m]
    for stage in stages:
        for scale, times in (("own", exaggeration(rows, (stage,))), ("same", same)):
            meta = {"stage": stage, "scale": scale, "times": times}
            visible = stage == shown and scale == "own"
            traces.append(_arrow_lines(arrows(rows, stage, times), meta, visible, head))
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


def _arrow_lines(
    found: Arrows, meta: dict[str, Any], visible: bool, head_m: float
) -> dict[str, Any]:
    points = _outlines(found, head_m)
    xyz = [[None if np.isnan(v) else float(v) for v in axis] for axis in points.reshape(-1, 3).T]
    notes = [
        f"row {k}: ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm"
        for k, (x, y, z) in zip(found.index, 1e3 * found.error_m, strict=True)
    ]
    color = LOOKS[found.stage].color
    return {
        "type": "scatter3d",
        **dict(zip("xyz", xyz, strict=True)),
        "mode": "lines+markers",
        "line": {"color": color, "width": 4},
        "marker": {
            "color": color,
            "size": [4, *[0] * (_POINTS - 1)] * len(notes),
            "line": {"width": 0},
        },
        "text": [entry for note in notes for entry in (note, note, *[""] * (_POINTS - 2))],
        "hoverinfo": "text",
        "meta": meta,
        "visible": visible,
        "showlegend": False,
    }


def _outlines(found: Arrows, head_m: float) -> np.ndarray:
    """(M, 10, 3) shaft, then out and back to the tip along four barbs, then a gap (NaN)."""
    shaft = found.stop_m - found.start_m
    length = np.linalg.norm(shaft, axis=1, keepdims=True)
    ahead = np.divide(shaft, length, out=np.zeros_like(shaft), where=length > 0)
    least = np.eye(3)[np.abs(ahead).argmin(axis=1)]
    aside = np.cross(ahead, least)
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
    across = np.cross(ahead, aside)
    size = np.minimum(head_m, 0.5 * length)
    neck = found.stop_m - size * ahead
    gap = np.full_like(shaft, np.nan)
    points = [found.start_m, found.stop_m]
    for sideways in (aside, across, -aside, -across):
        # Half width of a head over its length
        points += [neck + 0.45 * size * sideways, found.stop_m]
    return np.stack([*points[:-1], gap], axis=1)


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
