"""A plan, or what became of it, as a picture: the arm, its reach, boxes, floor, cameras, joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import ConvexHull, QhullError

from longarm_comp.arm_folder.visible import View
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.allowed_poses import FLOOR
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.collect.preview import Preview, kind_of
from longarm_comp.report.style import (
    BLUE,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    rc,
    save,
)

SUFFIXES = (".png", ".svg", ".pdf")
GOOD, NOT_DRIVEN = "", "not driven now"
_MARKS = ("x", "v", "s", "^", "D", "P", "*")
_COLOURS = (VERMILLION, ORANGE, PURPLE, INK)
_MOST_KINDS = 5
"""Faults that get a sign of their own."""


def check_suffix(path: Path) -> None:
    """Raise InputError where a picture cannot be of the kind that its name says."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError("picture", "FILE", path, f"a name that ends in {', '.join(SUFFIXES)}")


def draw(found: Preview, faults: Sequence[str], path: Path, good: str, title: str) -> None:
    """Draw every visit with its fault.

    Args:
        faults: what is wrong with each visit, or "".
        good: what a visit without a fault is called.
    """
    check_suffix(path)
    looks = _looks(faults, good)
    with rc():
        drawn = Figure(figsize=(11, 8.2), layout="constrained")
        drawn.suptitle(title, x=0.01, ha="left", fontsize=12)
        grid = drawn.add_gridspec(2, 2, height_ratios=(1.15, 1))
        kinds = np.array([_kind(fault, looks) for fault in faults])
        above, beside = drawn.add_subplot(grid[0, 0]), drawn.add_subplot(grid[0, 1])
        for axes, k, name in ((above, 1, "From above"), (beside, 2, "From the side")):
            _arm(axes, found, k, kinds, looks)
            axes.set_title(name)
        handles, labels = above.get_legend_handles_labels()
        drawn.legend(handles, labels, fontsize=9, loc="outside upper right", ncols=3)
        if found.view is None:
            _joints(drawn.add_subplot(grid[1, :]), found, kinds, looks)
        else:
            _images(drawn.add_subplot(grid[1, 0]), found, found.view, kinds, looks)
            _joints(drawn.add_subplot(grid[1, 1]), found, kinds, looks)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(drawn, path)


def coverage(found: Preview, made: Mapping[int, str], bag: Path) -> Path:
    """Draw what became of each visit (`Progress.made`), beside the bag; the file."""
    faults = [made.get(visit.index, NOT_DRIVEN) for visit in found.visits]
    path = bag.absolute().with_name(f"{bag.name}_coverage.png")
    draw(found, faults, path, "marker seen", f"{found.arm.name}: {bag.name}")
    return path


Look = tuple[str, str, str]
"""Colour, marker, label."""


def _looks(faults: Sequence[str], good: str) -> dict[str, Look]:
    """One look for each kind of fault, the most frequent first; the rest share one."""
    names = [kind_of(fault) for fault in faults]
    kinds = sorted({name for name in names if name}, key=lambda name: -names.count(name))
    looks = {GOOD: (BLUE, "o", f"{good}: {names.count(GOOD)} of {len(names)}")}
    for k, kind in enumerate(kinds[:_MOST_KINDS]):
        label = f"{kind}: {names.count(kind)}"
        looks[kind] = (_COLOURS[k % len(_COLOURS)], _MARKS[k], label)
    rest = sum(names.count(kind) for kind in kinds[_MOST_KINDS:])
    if rest:
        looks["other"] = (INK, _MARKS[_MOST_KINDS], f"other: {rest}")
    return looks


def _kind(fault: str, looks: dict[str, Look]) -> str:
    kind = kind_of(fault)
    return kind if kind in looks else "other"


def _points(axes: Axes, xy: np.ndarray, kinds: np.ndarray, looks: dict[str, Look]) -> None:
    for kind, (colour, marker, label) in looks.items():
        mine = kinds == kind
        axes.plot(*xy[mine].T, linestyle="", marker=marker, color=colour, markersize=5, label=label)


def _arm(axes: Axes, found: Preview, up: int, kinds: np.ndarray, looks: dict[str, Look]) -> None:
    """Arms and tips in the plane of x and another axis, or of y and z where that shows more."""
    tips = found.lines[:, -1]
    spread = np.ptp(tips, axis=0)
    across = 1 if up == 2 and spread[1] > spread[0] else 0
    plane = [across, up]
    _reach(axes, found.arm, plane)
    # Most arms drawn as lines
    for line in found.lines[:: max(1, len(found.lines) // 40)]:
        axes.plot(*line[:, plane].T, color=INK, alpha=0.22, linewidth=1.0, zorder=1)
    low, high = _extent(found, plane)
    for name, box in found.arm.keep_out.items():
        if name == FLOOR and up == 2:
            axes.axhspan(low[1], box.max_m[2], facecolor=VERMILLION, alpha=0.15, lw=0)
            axes.annotate(name, (low[0], low[1]), fontsize=8, color=VERMILLION)
            continue
        corner = np.maximum(np.array(box.min_m)[plane], low)
        size = np.minimum(np.array(box.max_m)[plane], high) - corner
        if (size <= 0).any() or name == FLOOR:
            continue
        axes.add_patch(Rectangle(tuple(corner), *size, facecolor=VERMILLION, alpha=0.15, lw=0))
        axes.annotate(name, tuple(corner + 0.02 * (high - low)), fontsize=8, color=VERMILLION)
    _points(axes, tips[:, plane], kinds, looks)
    if found.view is not None:
        _camera(axes, found.view, plane, tips)
    axes.plot(*np.array(found.arm.base.xyz_m)[plane], marker="s", color=INK, markersize=7)
    axes.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m")
    axes.set_aspect("equal", adjustable="datalim")


def _extent(found: Preview, plane: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of what the arm takes, with some room."""
    points = found.lines[..., plane].reshape(-1, 2)
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.1 * float((high - low).max())
    return low - room, high + room


def _reach(axes: Axes, arm: Arm, plane: list[int]) -> None:
    # Random joints whose tips outline the reach
    tips = declared_model(arm, deflection=False).tip(random_joints(arm, 2048))[:, plane]
    try:
        edge = tips[ConvexHull(tips).vertices]
    except QhullError:  # all on one line
        return
    axes.add_patch(Polygon(edge, facecolor=SKY, alpha=0.15, lw=0, label="reach inside the limits"))


def _camera(axes: Axes, view: View, plane: list[int], tips: np.ndarray) -> None:
    """The left camera and the edges of what it sees."""
    width, height = view.lens.size_px
    middle = view.lens.middle_px
    corners = [(x, y) for x in (0, width - 1) for y in (0, height - 1)]
    rays = np.array([[(x - middle[0]) / view.lens.focal_px, (y - middle[1]) / view.lens.focal_px,
                      1.0] for x, y in corners])  # fmt: skip
    place = view.left_in_base[:3, 3]
    length = float(((tips - place) @ view.left_in_base[:3, 2]).max())
    ends = place + length * rays @ view.left_in_base[:3, :3].T
    for end in ends[:, plane]:
        axes.plot(*np.array([place[plane], end]).T, color=INK, lw=0.6, ls=(0, (4, 3)))
    axes.plot(*place[plane], marker=">", color=INK, markersize=8)
    axes.annotate("left camera", tuple(place[plane]), fontsize=8, xytext=(5, 5),
                  textcoords="offset points")  # fmt: skip


def _images(
    axes: Axes, found: Preview, view: View, kinds: np.ndarray, looks: dict[str, Look]
) -> None:
    """Where the marker's middle is in the two images, one beside the other."""
    width, height = view.lens.size_px
    tips = declared_model(found.arm).pose(np.array([visit.q for visit in found.visits]))
    for k, (pixels, side) in enumerate(zip(view.pixels(tips), ("left", "right"), strict=True)):
        start = k * 1.08 * width
        axes.add_patch(Rectangle((start, 0), width, height, fill=False, edgecolor=INK, lw=1.0))
        axes.annotate(f"{side} camera", (start + 8, 24), fontsize=8)
        near = np.clip(pixels, [-0.04 * width, -0.06 * height], [1.04 * width, 1.06 * height])
        _points(axes, near + np.array([start, 0.0]), kinds, looks)
    axes.set(aspect="equal", xticks=[], yticks=[], xlim=(-0.1 * width, 2.18 * width))
    axes.set_ylim(1.12 * height, -0.12 * height)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set_title("Where the cameras have the marker (outside: drawn at the edge)")


def _joints(axes: Axes, found: Preview, kinds: np.ndarray, looks: dict[str, Look]) -> None:
    """Every joint's values as a share of its range."""
    arm = found.arm
    q = np.array([visit.q for visit in found.visits])
    share = (q - arm.lower) / (arm.upper - arm.lower)
    rng = np.random.default_rng(0)
    for j in range(arm.n):
        beside = j + rng.uniform(-0.28, 0.28, len(q))
        _points(axes, np.column_stack([beside, share[:, j]]), kinds, looks)
    axes.set_xticks(range(arm.n), arm.joint_names, rotation=30 if arm.n > 4 else 0, ha="right")
    axes.set(ylim=(-0.05, 1.05), ylabel="share of the range")
    axes.set_title("Joints, from lower to upper limit")
