"""The scene that turns with the mouse: the arm and its residual arrows, drawn by plotly."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import plotly.graph_objects as go

from longarm_comp.report.arrows import Arrows, arrows, exaggeration, extent_m, stages_of
from longarm_comp.report.detail import Rows
from longarm_comp.report.style import LOOKS

_SYMBOLS = {"o": "circle", "s": "square", "^": "circle-open", "X": "x", "D": "diamond"}
_ARM = "#8a8a8a"


def scene_json(rows: Rows, shown: str) -> str:
    """A plotly figure as JSON, safe to stand in a script element.

    Every stage has its arrows twice: at a scale of its own, and at one for all stages. `meta`
    of a trace says which: ``{"stage", "scale": "own|same", "times"}``.

    Args:
        rows: what to draw.
        shown: the stage that is visible first, at its own scale.
    """
    stages = stages_of(rows)
    same = exaggeration(rows, stages)
    traces: list[Any] = [_arm_line(line) for line in rows.arms_m]
    for stage in stages:
        for scale, times in (("own", exaggeration(rows, (stage,))), ("same", same)):
            found = arrows(rows, stage, times)
            meta = {"stage": stage, "scale": scale, "times": times}
            visible = stage == shown and scale == "own"
            traces += [
                _shafts(found, meta, visible),
                _heads(found, meta, visible, 0.02 * extent_m(rows)),
            ]
    figure = go.Figure(data=traces, layout=_layout())
    plain = _short(json.loads(figure.to_json()))
    return json.dumps(plain, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _arm_line(line: np.ndarray) -> Any:
    return go.Scatter3d(
        x=line[:, 0].tolist(),
        y=line[:, 1].tolist(),
        z=line[:, 2].tolist(),
        mode="lines+markers",
        line={"color": _ARM, "width": 6},
        marker={"color": _ARM, "size": 3},
        hoverinfo="skip",
        showlegend=False,
    )


def _shafts(found: Arrows, meta: dict[str, Any], visible: bool) -> Any:
    """Start and end of every arrow, with a gap after it, as one broken line."""
    xyz: list[list[float | None]] = [[], [], []]
    for start, stop in zip(found.start_m, found.stop_m, strict=True):
        for axis in range(3):
            xyz[axis] += [float(start[axis]), float(stop[axis]), None]
    notes = [_note(k, e) for k, e in zip(found.index, found.error_m, strict=True)]
    look = LOOKS[found.stage]
    return go.Scatter3d(
        x=xyz[0],
        y=xyz[1],
        z=xyz[2],
        mode="lines+markers",
        line={"color": look.color, "width": 3},
        marker={
            "color": look.color,
            "size": [3, 0, 0] * len(notes),
            "symbol": _SYMBOLS[look.marker],
            "line": {"width": 0},
        },
        text=[entry for note in notes for entry in (note, note, "")],
        hoverinfo="text",
        meta=meta,
        visible=visible,
        showlegend=False,
    )


def _heads(found: Arrows, meta: dict[str, Any], visible: bool, size_m: float) -> Any:
    along = found.stop_m - found.start_m
    length = np.linalg.norm(along, axis=1, keepdims=True)
    unit = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    color = LOOKS[found.stage].color
    return go.Cone(
        **{name: found.stop_m[:, k].tolist() for k, name in enumerate("xyz")},
        **{name: unit[:, k].tolist() for k, name in enumerate("uvw")},
        anchor="tip",
        sizemode="absolute",
        sizeref=size_m,
        colorscale=[[0, color], [1, color]],
        showscale=False,
        hoverinfo="skip",
        meta=meta,
        visible=visible,
    )


def _note(index: int, error_m: np.ndarray) -> str:
    x, y, z = error_m * 1e3
    return f"row {index}: ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm"


def _layout() -> dict[str, Any]:
    def axis(name: str) -> dict[str, Any]:
        return {"title": {"text": f"{name}, m"}, "showspikes": False, "backgroundcolor": "#f4f4f4"}

    return {
        "template": "none",
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "white",
        "scene": {
            **{f"{name}axis": axis(name) for name in "xyz"},
            "aspectmode": "data",
            "camera": {"eye": {"x": 1.1, "y": -1.5, "z": 0.7}},
        },
    }


def _short(value: Any) -> Any:
    """Numbers to a hundredth of a millimetre: nobody sees more, and the file stays small."""
    if isinstance(value, float):
        return round(value, 5)
    if isinstance(value, list):
        return [_short(entry) for entry in value]
    if isinstance(value, dict):
        return {key: _short(entry) for key, entry in value.items()}
    return value
