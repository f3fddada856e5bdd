"""The figures: errors of models or runs, over inputs, on the arm; what the scene draws."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from longarm_comp.report.detail import Input, Marked, SeenRows
from longarm_comp.report.noise_floor import normal_length
from longarm_comp.report.record import map_values
from longarm_comp.report.style import FLOOR, GRID, INK, LOOKS, VERMILLION, Look

_LEVELS = 8
"""An input with at most this many distinct values is drawn level by level."""


Sigma = tuple[float, float, float]
"""Noise along each axis, mm."""


def draw_errors_over(
    rows: SeenRows, entry: Input, before: str, after: str, sigma_mm: Sigma | None
) -> Figure:
    """Draw errors over one input: a row of panels per axis, before on the left, after on the right.

    Args:
        before, after: stages (`style.LOOKS`).
        sigma_mm: noise along each axis, drawn as a band.
    """
    drawn = Figure(figsize=(9, 6.4))
    panels = drawn.subplots(3, 2, sharex=True, sharey="row")
    spread = values = np.asarray(entry.values, dtype=float)
    levels = np.unique(values)
    by_level = 1 < len(levels) <= _LEVELS
    if by_level:
        # A small jitter, so that points of a level do not overlap
        jitter = np.arange(len(values)) * 0.618034 % 1 - 0.5
        spread = values + 0.16 * np.diff(levels).min() * jitter
    # Medians are of each level, or of ten bins of equal count
    if len(levels) <= _LEVELS:
        groups = [np.flatnonzero(values == level) for level in levels]
    else:
        bins = np.array_split(np.argsort(values, kind="stable"), min(10, len(values)))
        groups = [group for group in bins if len(group)]
    centre = np.array([np.median(values[group]) for group in groups])
    for column, stage in enumerate((before, after)):
        look = LOOKS[stage]
        for axis, name in enumerate("xyz"):
            panel = panels[axis, column]
            error = rows.errors_m[stage][:, axis] * 1e3
            if sigma_mm is not None:
                half = 1.96 * sigma_mm[axis]
                panel.axhspan(-half, half, color=GRID, alpha=0.6, linewidth=0)
            panel.axhline(0, color=INK, linewidth=0.8)
            # Above this many points, a scatter plot is rasterised
            dots = {"linestyle": "", "markersize": 3, "alpha": 0.6, "rasterized": len(error) > 800}
            panel.plot(spread, error, marker=look.marker, color=look.color, **dots)
            middle = np.array([np.median(error[group]) for group in groups])
            panel.plot(centre, middle, color=INK, marker="_", markersize=12, linewidth=1.6)
            if column == 0:
                panel.set_ylabel(f"{name} error, mm")
        panels[0, column].set_title(("Before: " if column == 0 else "After: ") + look.label)
        panels[2, column].set_xlabel(f"{entry.name}, {entry.unit}" if entry.unit else entry.name)
    if by_level:
        panels[2, 0].set_xticks(levels, [f"{level:.2g}" for level in levels])
    drawn.subplots_adjust(left=0.07, right=0.99, bottom=0.075, top=0.96, wspace=0.04, hspace=0.08)
    return drawn


_RING: Any = {"marker": "o", "markersize": 16, "markerfacecolor": "none", "markeredgewidth": 2.2}
_LABEL: Any = {"textcoords": "offset points", "fontsize": 10, "fontweight": "bold"}


def draw_places(found: Marked) -> Figure:
    """Draw the arm from the side in which it is longest, with the places of a finding."""
    drawn = Figure(figsize=(3.2, 2.6))
    axes = drawn.subplots()
    points = np.concatenate([found.arm_m, np.array(list(found.places_m.values())).reshape(-1, 3)])
    flat = found.arm_m[:, :2] - found.arm_m[0, :2]
    aside = np.linalg.svd(flat)[2][0]
    aside *= np.sign(flat[-1] @ aside) or 1.0

    def project(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (at[..., :2] - found.arm_m[0, :2]) @ aside, at[..., 2]

    axes.plot(*project(found.arm_m), color="#8a8a8a", linewidth=5, solid_capstyle="round")
    axes.plot(*project(found.arm_m[:1]), marker="s", markersize=9, color=INK)
    axes.plot(*project(found.arm_m[-1:]), marker="x", markersize=7, color=INK)
    low, high = np.min(project(points), axis=1), np.max(project(points), axis=1)
    # Places nearer to each other than this share of the picture get one ring
    close, groups = 0.06 * float((high - low).max()), list[list[str]]()
    for where, point in found.places_m.items():
        near = (g for g in groups if np.linalg.norm(found.places_m[g[0]] - point) < close)
        group = next(near, None)
        if group is None:
            groups.append([where])
        else:
            group.append(where)
    for names in groups:
        x, z = project(np.mean([found.places_m[where] for where in names], axis=0))
        axes.plot(x, z, color=VERMILLION, **_RING)
        label = ", ".join(where.split(",")[0].rsplit(" ", 1)[-1].strip("()") for where in names)
        aside_px, align = (8, "left") if x < (low[0] + high[0]) / 2 else (-8, "right")
        axes.annotate(label, (x, z), (aside_px, 9), color=INK, ha=align, **_LABEL)
    room = 0.14 * max(float((high - low).max()), 1e-3)
    axes.set(
        xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room), aspect="equal"
    )
    axes.axis("off")
    drawn.subplots_adjust(left=0, right=1, bottom=0, top=1)
    return drawn


_BOXES: Any = {
    "patch_artist": True,
    "whis": (2.5, 97.5),
    "showfliers": False,
    "medianprops": {"color": INK, "linewidth": 1.5},
}


def draw_errors_at_tip(
    errors: Mapping[str, np.ndarray],
    looks: Sequence[Look] = tuple(LOOKS.values()),
    *,
    rows: str = "targets",
    error: str = "tip − target",
    sigma_mm: Sigma | None = None,
) -> Figure:
    """Draw the share of rows below an error, and the error along each axis.

    Args:
        errors: (N, 3) m, by name of the run, without lost markers.
        looks: the styles of the runs, in order.
        rows, error: what the labels call them.
        sigma_mm: noise along each axis, drawn as a floor.
    """
    drawn = Figure(figsize=(9, 3.8))
    left, right = drawn.subplots(1, 2, width_ratios=(1.15, 1))
    width = 0.8 / max(1, len(errors))
    for k, (name, held) in enumerate(errors.items()):
        look = looks[k % len(looks)]
        length = np.sort(np.linalg.norm(held, axis=1)) * 1e3
        share = (np.arange(len(length)) + 1) / max(1, len(length))
        line = {"color": look.color, "linestyle": look.dash, "marker": look.marker, "markersize": 5}
        every = max(1, len(length) // 8)
        left.plot(np.maximum(length, 1e-4), share, label=name, markevery=every, **line)
        at = np.arange(3) + (k - (len(errors) - 1) / 2) * width
        boxes = right.boxplot(list((held * 1e3).T), positions=at, widths=width * 0.8, **_BOXES)
        for box in boxes["boxes"]:
            box.set(facecolor="white", edgecolor=look.color, hatch=look.hatch)
    if sigma_mm is not None:
        scale = float(np.sqrt(np.mean(np.square(sigma_mm))))
        below = np.linspace(0.005, 0.995, 200)
        left.plot(scale * normal_length(below), below, color=INK, linewidth=1, label=FLOOR)
    left.set(
        xscale="log",
        ylim=(0, 1.02),
        xlabel=f"|{error}|, mm (log scale)",
        ylabel=f"share of {rows}",
        title=f"Share of {rows} below an error",
    )
    left.xaxis.set_major_formatter("{x:g}")
    left.legend(fontsize=8, loc="best")
    right.axhline(0, color=INK, linewidth=0.8)
    right.set_xticks(range(3), ["x", "y", "z"])
    right.set(
        ylabel=f"{error}, mm",
        yscale="symlog",
        title="Per axis: quartiles and 95 % range\n(from left to right in the order of the legend)",
    )
    right.yaxis.set_major_formatter("{x:g}")
    drawn.subplots_adjust(left=0.07, right=0.99, bottom=0.13, top=0.86, wspace=0.25)
    return drawn


MOST = 150
"""Largest number of arrows in one figure, drawn evenly along the session."""
_ROUND = np.array([1.0, 2.0, 5.0])


def stages_of(rows: SeenRows) -> tuple[str, ...]:
    return tuple(stage for stage in LOOKS if stage in rows.errors_m)


def exaggeration(rows: SeenRows, stage: str) -> float:
    """Return the factor on a stage's arrows: 95 % of them are then at most some 15 % of the scene.

    It is 1, 2 or 5 times a power of ten.
    """
    length = np.linalg.norm(rows.errors_m[stage], axis=1)
    long = float(np.percentile(length, 95)) if len(length) else 0.0
    if long <= 0:
        return 1.0
    points = np.concatenate([rows.measured_m, *rows.arms_m])
    wanted = max(1.0, 0.15 * float(np.ptp(points, axis=0).max()) / long)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * _ROUND[wanted / decade * (1 + 1e-9) >= _ROUND].max())


def scene_json(rows: SeenRows) -> str:
    """Return the scene that report.js draws, in m, as JSON that is safe in a script element.

    Every stage has its own factor on its arrows (`exaggeration`).
    """
    n = len(rows.index)
    taken = np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int))
    stages = {
        stage: {
            "times": exaggeration(rows, stage),
            "color": LOOKS[stage].color,
            "errors": rows.errors_m[stage][taken].tolist(),
        }
        for stage in stages_of(rows)
    }
    plain = {
        "arms": [line.tolist() for line in rows.arms_m],
        "rows": rows.index[taken].tolist(),
        "tips": rows.measured_m[taken].tolist(),
        "stages": stages,
    }
    # To a hundredth of a millimetre, to keep the file small
    short = map_values(plain, float, lambda v: round(v, 5))
    return json.dumps(short, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
