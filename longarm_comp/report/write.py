"""Writes the files of a diagnosis: report.json, report.html (self-contained), plots."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from longarm_comp.core.files import atomic_path, write_text
from longarm_comp.core.identify.structure import SIGNIFICANT
from longarm_comp.report import cards, plots, record, style, words
from longarm_comp.report.detail import Detail
from longarm_comp.report.noise_floor import floor_of
from longarm_comp.report.pages import data_uri, template
from longarm_comp.report.plots import MOST, at_the_tip, scene_json, stages_of


def write_report(report: dict[str, Any], detail: Detail, folder: str | os.PathLike[str]) -> Path:
    """Write ``report.json``, ``report.html`` and ``plots/*.svg``; return the page's path.

    The same diagnosis gives the same bytes. Files of an earlier report are replaced. Nothing is
    written if the report violates the schema.

    Raises:
        InputError: the report violates the schema, or the folder cannot be written to.
    """
    checked = record.checked(report)
    drawn = _drawn(checked.for_people(), detail)
    html = page(checked, detail, drawn)
    target = Path(folder)
    for name, content in drawn.items():
        with atomic_path(target / "plots" / f"{name}.svg") as partial:
            partial.write_bytes(content)
    for old in (target / "plots").glob("*.svg"):
        if old.stem not in drawn:
            old.unlink()
    write_text(target / "report.json", record.text(checked))
    write_text(target / "report.html", html)
    return target / "report.html"


def _drawn(report: record.DiagnosisReport, detail: Detail) -> dict[str, bytes]:
    figures: dict[str, Figure] = {}
    rows, held, floor = detail.held_out, report.held_out, floor_of(report)
    sigma_mm = None if floor is None else floor.sigma_mm
    with style.rc():
        for number, found in enumerate(detail.marked, 1):
            figures[place_name(number)] = plots.place(found)
        if rows is not None and len(rows.index) and rows.errors_m:
            stages = stages_of(rows)
            figures["distribution"] = at_the_tip(
                {style.LOOKS[k].label: rows.errors_m[k] for k in stages},
                [style.LOOKS[k] for k in stages],
                rows="hold-out rows",
                error="measured − predicted",
                sigma_mm=sigma_mm,
            )
            if held.before in stages and held.after in stages:
                inputs = {entry.name: entry for entry in rows.inputs}
                for name in detail.guilty:
                    figures[against(name)] = plots.against_input(
                        rows, inputs[name], held.before, held.after, sigma_mm
                    )
        return {name: style.svg(figure) for name, figure in figures.items()}


def page(report: record.DiagnosisReport, detail: Detail, plots: Mapping[str, bytes]) -> str:
    """The page as text, joints by their names; ``plots``: SVG of the still figures by name."""
    report = report.for_people()
    rows = detail.held_out if detail.held_out is not None and len(detail.held_out.index) else None
    stages = stages_of(rows) if rows else ()
    before = report.held_out.before
    shown = before if before in stages else next(iter(stages), "")
    return template("report.html.j2").render(
        report=report,
        detail=detail,
        cards=cards,
        words=words,
        picture=place_name,
        significant=SIGNIFICANT,
        rows=rows,
        looks=style.LOOKS,
        against=against,
        stages=stages,
        shown=shown,
        floor=floor_of(report),
        floor_label=style.FLOOR,
        most=MOST,
        plots={name: data_uri(content) for name, content in plots.items()},
        scene=scene_json(rows) if rows else None,
    )


def place_name(number: int) -> str:
    """The name of the figure of where a finding is, counted from 1."""
    return f"place_{number}"


def against(name: str) -> str:
    """The name of the figure of the errors over an input; a column may be called anything."""
    return "against_" + re.sub(r"\W", "_", name)
