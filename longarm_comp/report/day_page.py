"""The one page of a day of work: errors over the hours, what was learned, what went wrong."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.report.style import BLUE, VERMILLION, rc, svg
from longarm_comp.report.template import beside, data_uri, template
from longarm_comp.sessions.day import Day, Notice


def day_page(arm: str, bag: str, day: Day) -> str:
    """The page as text, self-contained; ``arm``, ``bag``: what they are called."""
    changes = [s for s in day.said if s.level == 0]
    with rc():
        picture = data_uri(svg(_errors(day, changes)))
    troubles = [s for s in day.said if s.level > 0]
    return template("day.html.j2").render(
        arm=arm, bag=bag, hours=day.hours, rows=day.by_hour(), refused=day.refused.most_common(),
        changes=[(_clock(s.first_s), s.message) for s in changes],
        troubles=[(_clock(s.first_s), _clock(s.last_s), s.part, s.message) for s in troubles],
        picture=picture, style=beside("report.css"),
    )  # fmt: skip


def _errors(day: Day, changes: list[Notice]) -> Figure:
    drawn = Figure(figsize=(9, 3.4), layout="constrained")
    axes = drawn.subplots()
    hour = np.array([s.t_s / 3600.0 for s in day.served])
    axes.plot(
        hour, [s.error_mm for s in day.served], color=BLUE, marker="o", markersize=3, linestyle="",
        label="a target",
    )  # fmt: skip
    for k, said in enumerate(changes[1:]):
        axes.axvline(
            said.first_s / 3600.0, color=VERMILLION, linestyle="--", linewidth=0.9,
            label=None if k else "something learned",
        )  # fmt: skip
    axes.set_xlabel("hours since the recording began")
    axes.set_ylabel("tip − target, mm")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left")
    return drawn


def _clock(t_s: float) -> str:
    minutes = int(t_s // 60)
    return f"{minutes // 60}:{minutes % 60:02d}"
