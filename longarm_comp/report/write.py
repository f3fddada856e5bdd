"""Writes the files of a diagnosis: report.json, report.html, plots."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path, write_text
from longarm_comp.report import plots, record, style, tables
from longarm_comp.report.arrows import stages_of
from longarm_comp.report.detail import Detail, SeenRows
from longarm_comp.report.page import against, page, place_name, still_stages

_SAME_MM = 1e-6
_BARS = 15


def write_report(report: dict[str, Any], detail: Detail, folder: str | os.PathLike[str]) -> Path:
    """Write ``report.json``, ``report.html`` and ``plots/*.svg``; return the page's path.

    The same diagnosis gives the same bytes. Nothing is written if the report violates the schema,
    or if its hold-out table differs from the errors in `detail`.

    Args:
        report: contents of report.json.
        detail: further data of the page.
        folder: created if missing. Files of an earlier report are replaced.

    Raises:
        InputError: the report violates the schema or contradicts the detail, or the folder cannot
            be written to.
    """
    checked = record.checked(report)
    _agree(checked, detail)
    drawn = _drawn(checked, detail)
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
    """Name -> SVG of every still figure that this diagnosis has."""
    figures: dict[str, Figure] = {}
    rows = detail.held_out
    floor = tables.floor_of(report)
    sigma_mm = None if floor is None else floor.sigma
    with style.rc():
        for number, found in enumerate(detail.marked, 1):
            figures[place_name(number)] = plots.place(found)
        if rows is not None and len(rows.index) and rows.errors_m:
            figures["distribution"] = plots.distribution(rows, sigma_mm)
            figures["scene"] = plots.still_scene(rows, still_stages(detail))
            if {detail.before, detail.after} <= set(stages_of(rows)):
                for name in detail.guilty:
                    entry = rows.input(name)
                    if entry is None:
                        raise InputError("report detail", "guilty", name, _names(rows))
                    figures[against(name)] = plots.against_input(
                        rows,
                        entry,
                        detail.before,
                        detail.after,
                        sigma_mm,
                        detail.train,
                    )
        if detail.correlation is not None and detail.correlation.matrix.size:
            figures["correlation"] = plots.correlations(detail.correlation)
        scored = [line for line in tables.candidate_lines(report) if line.score is not None]
        if scored:
            best = scored[:_BARS]
            figures["scores"] = plots.scores(
                [f"{line.effect}, {line.where}" for line in best],
                [line.score or 0.0 for line in best],
                [line.state == "accepted" for line in best],
            )
        return {name: style.svg(figure) for name, figure in figures.items()}


def _names(rows: SeenRows) -> str:
    return ", ".join(entry.name for entry in rows.inputs)


def _agree(report: record.DiagnosisReport, detail: Detail) -> None:
    """Check that the table and the figures show the same errors."""
    rows = detail.held_out
    if rows is None:
        return
    if len(rows.index) != report.held_out.n:
        raise InputError("report.json", "held_out.n", report.held_out.n, f"{len(rows.index)} rows")
    compared = (report.held_out.before, report.held_out.after)
    if report.held_out.before and compared != (detail.before, detail.after):
        raise InputError("report detail", "before, after", (detail.before, detail.after), compared)
    for line in report.held_out.rows:
        if line.model not in rows.errors_m:
            raise InputError("report detail", "errors_m", list(rows.errors_m), line.model)
        error = rows.errors_m[line.model] * 1e3
        length = np.linalg.norm(error, axis=1)
        for name, stated, found in (
            ("mean_mm", line.mean_mm, length.mean()),
            ("rms_mm", line.rms_mm, np.sqrt((length**2).mean())),
            ("max_mm", line.max_mm, length.max()),
            ("mean_abs_z_mm", line.mean_abs_z_mm, np.abs(error[:, 2]).mean()),
        ):
            if abs(stated - found) > _SAME_MM * max(1.0, found):
                raise InputError(
                    "report.json", f"held_out.{line.model}.{name}", stated, f"{found:.9g}"
                )
