"""The one page of many arms: which drift, what belongs to their kind, what each one has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.report.style import BLUE, GREEN, ORANGE, rc, svg
from longarm_comp.report.template import beside, data_uri, template

_MODELS = {
    "in_use_mm": ("model in use", ORANGE, "s"),
    "calibrated_mm": ("calibrated anew", BLUE, "^"),
    "diagnosed_mm": ("diagnosed", GREEN, "o"),
}
_ROW_IN = 0.22


def fleet_page(name: str, arms: Sequence[Mapping[str, Any]]) -> str:
    """The page of a folder as text, with links to the diagnosis of each arm (row of fleet.json)."""
    with rc():
        picture = data_uri(svg(_errors(arms)))
    return template("fleet.html.j2").render(
        name=name, arms=arms, kinds=_kinds(arms), picture=picture, style=beside("report.css"),
        drifted=[arm for arm in arms if arm["drifted"]],
        failed=[arm for arm in arms if arm["verdict"] == "failed"],
        compared=sum(arm["in_use_mm"] is not None for arm in arms),
    )  # fmt: skip


def _kinds(arms: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A kind of several arms each: its arms, and what is found at half of them."""
    made = []
    for kind in dict.fromkeys(arm["kind"] for arm in arms):
        mine = [arm for arm in arms if arm["kind"] == kind]
        shared: dict[tuple[str, str], list[float]] = {}
        for arm in mine:
            for f in arm["findings"]:
                if f["of_kind"]:
                    shared.setdefault((f["effect"], f["where"]), []).append(f["tip_mm"])
        rows = [
            (*key, len(sizes), float(np.median(sizes)), min(sizes), max(sizes))
            for key, sizes in sorted(shared.items(), key=lambda item: -len(item[1]))
        ]
        if len(mine) > 1:
            made.append({"arms": [arm["name"] for arm in mine], "rows": rows})
    return made


def _errors(arms: Sequence[Mapping[str, Any]]) -> Figure:
    """A line an arm, a mark a model that is known of any."""
    figure = Figure(figsize=(7.6, 1.2 + _ROW_IN * len(arms)), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(arms))
    for key, (label, color, marker) in _MODELS.items():
        known = [np.nan if arm[key] is None else arm[key] for arm in arms]
        if not np.isnan(known).all():
            axes.plot(known, place, color=color, marker=marker, linestyle="", label=label)
            axes.legend(loc="best")
    axes.set_yticks(place, [arm["name"] for arm in arms])
    axes.set_ylim(len(arms) - 0.5, -0.5)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("mean error, mm")
    return figure
