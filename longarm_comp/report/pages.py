"""Pages from templates, each one self-contained file: of a diagnosis, a loop, many arms, a day.

A diagnosis has report.json and plots beside its page.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_writable, write_bytes, write_text
from longarm_comp.core.identify.structure import SIGNIFICANT
from longarm_comp.report import cards, plots, record, style, words
from longarm_comp.report.detail import Detail
from longarm_comp.report.noise_floor import floor_of
from longarm_comp.report.plots import MOST, draw_errors_at_tip, scene_json, stages_of
from longarm_comp.report.style import BLUE, GREEN, ORANGE, VERMILLION, rc, svg

if TYPE_CHECKING:
    from longarm_comp.sessions.day import Day


@cache
def template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("longarm_comp.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def data_uri(svg: bytes) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode('ascii')}"


def write_report(
    report: record.DiagnosisReport,
    detail: Detail,
    folder: str | os.PathLike[str],
    write_others: Callable[[], object] = lambda: None,
) -> Path:
    """Write ``report.json``, ``report.html`` and ``plots/*.svg``; return the page's path.

    The same diagnosis gives the same bytes. Files of an earlier report are replaced; no other is
    touched. An earlier report.json goes first and the new one comes last, so that it never stands
    beside files of another diagnosis, wherever this is broken off.

    Args:
        write_others: writes the files that belong to the report.

    Raises:
        InputError: the folder cannot be written to, or a plot of another program has the name of
            one of this report.
    """
    named = report.for_people()
    drawn = _draw_figures(named, detail)
    html = page(named, detail, drawn)
    target = Path(folder)
    files = {target / "plots" / f"{name}.svg": content for name, content in drawn.items()}
    there = [path for path in (target / "plots").glob("*.svg") if path.is_file()]
    for path in there:
        if path in files and not style.is_signed(path):
            raise InputError(path, "plot", "exists and is no plot of a diagnosis", "another folder")
    check_writable(target)
    (target / "report.json").unlink(missing_ok=True)
    for path, content in files.items():
        write_bytes(path, content)
    for path in there:
        if path not in files and _FIGURE.fullmatch(path.stem) and style.is_signed(path):
            path.unlink()
    write_text(target / "report.html", html)
    write_others()
    write_text(target / "report.json", record.text(report))
    return target / "report.html"


def _draw_figures(report: record.DiagnosisReport, detail: Detail) -> dict[str, bytes]:
    figures: dict[str, Figure] = {}
    rows, held, floor = detail.held_out, report.held_out, floor_of(report)
    sigma_mm = None if floor is None else floor.sigma_mm
    with rc():
        for number, found in enumerate(detail.marked, 1):
            figures[place_name(number)] = plots.draw_places(found)
        if rows is not None and len(rows.index) and rows.errors_m:
            stages = stages_of(rows)
            figures["distribution"] = draw_errors_at_tip(
                {style.LOOKS[k].label: rows.errors_m[k] for k in stages},
                [style.LOOKS[k] for k in stages],
                rows="hold-out rows",
                error="measured − predicted",
                sigma_mm=sigma_mm,
            )
            if held.before in stages and held.after in stages:
                inputs = {entry.name: entry for entry in rows.inputs}
                for name in detail.guilty:
                    figures[against(name)] = plots.draw_errors_over(
                        rows, inputs[name], held.before, held.after, sigma_mm
                    )
        return {name: svg(figure) for name, figure in figures.items()}


def page(report: record.DiagnosisReport, detail: Detail, plots: Mapping[str, bytes]) -> str:
    """Return the HTML page of a report that `DiagnosisReport.for_people` returned.

    Args:
        plots: SVG of the still figures, by name.
    """
    rows = detail.held_out if detail.held_out is not None and len(detail.held_out.index) else None
    stages = stages_of(rows) if rows else ()
    before = report.held_out.before
    split = {by.members[0] for by in detail.splits if by.poses}
    found = cards.cards(report, split)
    shown = before if before in stages else next(iter(stages), "")
    return template("report.html.j2").render(
        report=report,
        detail=detail,
        found=found,
        to_do=cards.to_do(found),
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
    """Return the name of the figure that shows where finding `number` (counted from 1) is."""
    return f"place_{number}"


def against(name: str) -> str:
    """Return the name of the figure of the errors over an input, which may have any name."""
    return "against_" + re.sub(r"\W", "_", name)


_FIGURE = re.compile(r"place_\d+|distribution|against_\w+")
"""Every name that a figure of a diagnosis may have."""


def loop_page(data: Mapping[str, Any], errors: Mapping[str, np.ndarray]) -> str:
    """Return the HTML page of a loop.

    Args:
        data: the contents of loop.json.
        errors: (N, 3) tip - target, m, by name of the run.
    """
    with rc():
        picture = data_uri(svg(draw_errors_at_tip(errors)))
    return template("loop.html.j2").render(picture=picture, loop=data)


_MODELS = {
    "in_use_mm": ("model in use", ORANGE, "s"),
    "calibrated_mm": ("calibrated anew", BLUE, "^"),
    "diagnosed_mm": ("diagnosed", GREEN, "o"),
}
_ROW_IN = 0.22


def fleet_page(name: str, arms: Sequence[Mapping[str, Any]]) -> str:
    """Return the HTML page of a folder of arms, with links to the diagnosis of each.

    Args:
        name: name of the folder.
        arms: the rows of fleet.json.
    """
    with rc():
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
        picture = data_uri(svg(figure))
    return template("fleet.html.j2").render(
        picture=picture,
        name=name,
        arms=arms,
        kinds=_list_kinds(arms),
        drifted=[arm for arm in arms if arm["drifted"]],
        failed=[arm for arm in arms if arm["verdict"] == "failed"],
        compared=sum(arm["in_use_mm"] is not None for arm in arms),
    )


def _list_kinds(arms: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the kinds that have several arms: names of the arms, and findings that they share."""
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


def day_page(arm: str, bag: str, day: Day) -> str:
    """Return the HTML page of a day at work.

    Args:
        arm, bag: names of the arm and of the bag, for the page.
    """
    changes = [s for s in day.said if s.level == 0]
    troubles = [s for s in day.said if s.level > 0]
    with rc():
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        axes = figure.subplots()
        dots: Any = {"color": BLUE, "marker": "o", "markersize": 3, "linestyle": ""}
        axes.plot(day.t_s / 3600.0, day.error_mm, label="a target", **dots)
        for k, said in enumerate(changes[1:]):
            label = None if k else "something learned"
            line: Any = {"color": VERMILLION, "linestyle": "--", "linewidth": 0.9, "label": label}
            axes.axvline(said.first_s / 3600.0, **line)
        axes.set_xlabel("hours since the recording began")
        axes.set_ylabel("tip − target, mm")
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="upper left")
        picture = data_uri(svg(figure))
    return template("day.html.j2").render(
        picture=picture,
        arm=arm,
        bag=bag,
        hours=day.hours,
        rows=day.by_hour(),
        refused=day.refused.most_common(),
        changes=[(_clock_of(s.first_s), s.message) for s in changes],
        troubles=[(_clock_of(s.first_s), _clock_of(s.last_s), s.part, s.message) for s in troubles],
    )


def _clock_of(t_s: float) -> str:
    minutes = int(t_s // 60)
    return f"{minutes // 60}:{minutes % 60:02d}"
