"""report.html: one self-contained file, from a template."""

from __future__ import annotations

import re
from collections.abc import Mapping

from longarm_comp.core.identify.structure import SIGNIFICANT
from longarm_comp.report import cards, verdict, words
from longarm_comp.report.detail import Detail
from longarm_comp.report.noise_floor import floor_of
from longarm_comp.report.pages import beside, data_uri, template
from longarm_comp.report.record import DiagnosisReport
from longarm_comp.report.scene import MOST, exaggeration, scene_json, stages_of
from longarm_comp.report.style import FLOOR, LOOKS

_FEW = 20
"""Number of candidates shown; the others are folded."""


def page(report: DiagnosisReport, detail: Detail, plots: Mapping[str, bytes]) -> str:
    """The page as text, joints by their names; ``plots``: SVG of the still figures by name."""
    report = report.for_people()
    rows = detail.held_out if detail.held_out is not None and len(detail.held_out.index) else None
    candidates = words.best_first(report)
    stages = stages_of(rows) if rows else ()
    shown = detail.before if detail.before in stages else next(iter(stages), "")
    return template("report.html.j2").render(
        report=report,
        detail=detail,
        cards=cards,
        verdict=verdict,
        words=words,
        picture=place_name,
        significant=SIGNIFICANT,
        rows=rows,
        candidates=candidates[:_FEW],
        more_candidates=candidates[_FEW:],
        looks=LOOKS,
        against=against,
        stages=stages,
        shown=shown,
        floor=floor_of(report),
        floor_label=FLOOR,
        most=MOST,
        plots={name: data_uri(content) for name, content in plots.items()},
        still_times=exaggeration(rows, still_stages(detail)) if rows else 1.0,
        scene=scene_json(rows) if rows else None,
        style=beside("report.css"),
        script=beside("report.js"),
    )


def still_stages(detail: Detail) -> tuple[str, ...]:
    """Stages before and after if the hold-out has both; else its first and last stage."""
    rows = detail.held_out
    if rows is None:
        return ()
    have = stages_of(rows)
    wanted = tuple(stage for stage in (detail.before, detail.after) if stage in have)
    return wanted or tuple(dict.fromkeys((*have[:1], *have[-1:])))


def place_name(number: int) -> str:
    """The name of the figure of where a finding is, counted from 1."""
    return f"place_{number}"


def against(name: str) -> str:
    """The name of the figure of the errors over an input; a column may be called anything."""
    return "against_" + re.sub(r"\W", "_", name)
