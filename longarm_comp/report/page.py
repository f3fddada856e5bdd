"""report.html: one self-contained file, from a template."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from importlib.resources import files

from plotly.offline import get_plotlyjs

from longarm_comp.core.identify.structure import SIGNIFICANT
from longarm_comp.report import cards, tables, verdict, words
from longarm_comp.report.detail import Detail
from longarm_comp.report.open_questions import open_questions
from longarm_comp.report.record import DiagnosisReport
from longarm_comp.report.scene import MOST, exaggeration, scene_json, stages_of
from longarm_comp.report.style import LOOKS
from longarm_comp.report.template import template

_FEW = 20
"""Number of candidates shown; the others are folded."""


def page(report: DiagnosisReport, detail: Detail, plots: Mapping[str, bytes]) -> str:
    """The page as text.

    Args:
        report: the diagnosis.
        detail: further data of the page.
        plots: name -> SVG of the still figures.
    """
    rows = detail.held_out if detail.held_out is not None and len(detail.held_out.index) else None
    candidates = tables.candidate_lines(report)
    return template("report.html.j2").render(
        report=report,
        detail=detail,
        cards=cards,
        verdict=verdict,
        open_questions=open_questions,
        tables=tables,
        words=words,
        picture=place_name,
        significant=SIGNIFICANT,
        rows=rows,
        candidates=candidates[:_FEW],
        more_candidates=candidates[_FEW:],
        looks=LOOKS,
        against=against,
        stages=stages_of(rows) if rows else (),
        shown=_shown(detail, stages_of(rows) if rows else ()),
        most=MOST,
        plots={name: _data_uri(content) for name, content in plots.items()},
        still_times=exaggeration(rows, still_stages(detail)) if rows else 1.0,
        scene=scene_json(rows, _shown(detail, stages_of(rows))) if rows else None,
        style=_own("report.css"),
        script=_own("report.js"),
        plotly=get_plotlyjs().replace("</script", "<\\/script") if rows else None,
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


def _shown(detail: Detail, stages: tuple[str, ...]) -> str:
    return detail.before if detail.before in stages else next(iter(stages), "")


def _own(name: str) -> str:
    return files("longarm_comp.report").joinpath("templates").joinpath(name).read_text("utf-8")


def _data_uri(svg: bytes) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode('ascii')}"
