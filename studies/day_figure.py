"""Figure of the day of work: error at the true tip over the hours, and the circumstances."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from longarm_comp.report.style import BLUE, GREEN, INK, ORANGE, PURPLE, VERMILLION, rc, save
from studies.day_work import DayOutcome

_LINES = (
    (INK, "X", ":"),
    (PURPLE, "s", "-."),
    (ORANGE, "^", "--"),
    (BLUE, "o", "-"),
)


def draw_days(found: Sequence[DayOutcome], path: Path) -> None:
    """Draw the mean over the days (line) and each day's hours (marks).

    Below are temperature, payload and play.

    Args:
        found: days of equal length.
        path: PNG to write.
    """
    with rc():
        drawn = Figure(figsize=(7.6, 6.4), layout="constrained")
        upper, *lower = drawn.subplots(4, 1, sharex=True, height_ratios=(4.6, 1, 1, 1))
        _errors(upper, found)
        _circumstances(lower, found)
        save(drawn, path)


def _errors(axes: Axes, found: Sequence[DayOutcome]) -> None:
    t = found[0].t_h
    hours = np.arange(int(np.ceil(t[-1])))
    of_hour = np.floor(t)[None, :] == hours[:, None]
    errors = 1e3 * np.stack([day.error for day in found])
    by_hour = np.stack([np.nanmean(errors[..., chosen], axis=-1) for chosen in of_hour], axis=-1)
    lines = itertools.cycle(_LINES)
    for i, (way, (color, marker, dash)) in enumerate(zip(found[0].ways, lines, strict=False)):
        axes.plot(
            hours + 0.5, np.nanmean(by_hour[:, i], axis=0), color=color, linestyle=dash,
            marker=marker, label=way,
        )  # fmt: skip
        for day in by_hour[:, i]:
            axes.plot(
                hours + 0.5, day, color=color, linestyle="", marker=marker, markersize=3, alpha=0.35
            )
    asked = [stop.hour for day in found for stop in day.stops]
    axes.plot(
        asked, np.full(len(asked), 0.02), transform=axes.get_xaxis_transform(), clip_on=False,
        color=VERMILLION, marker="|", markersize=9, linestyle="", label="it is measured",
    )  # fmt: skip
    axes.set_yscale("log")
    axes.set_ylabel("error of the true tip, mm")
    many = "s" if len(found) > 1 else ""
    axes.set_title(f"A day of work: mean of each hour, {len(found)} arm{many}")
    axes.legend(ncols=2, fontsize=8)


def _circumstances(panels: Sequence[Axes], found: Sequence[DayOutcome]) -> None:
    day = found[0]
    panels[0].plot(day.t_h, day.temperature_c, color=VERMILLION)
    panels[0].set_ylabel("degC")
    panels[1].step(day.t_h, day.payload_kg, color=GREEN, where="mid")
    panels[1].set_ylabel("payload, kg")
    for each in found:
        panels[2].plot(each.t_h, 2e3 * each.play_rad, color=INK)
    panels[2].set(ylabel="play, mrad", xlabel="hours of work")
