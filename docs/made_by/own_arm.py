"""Pictures of docs/your_own_arm.md: rows of the table, beams, marker and cameras."""

import cv2
import numpy as np
import yaml
from drawing import BLUE, GREEN, GREY, INK, ORANGE, VERMILLION, arrow, bare
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon, Rectangle
from numpy.typing import ArrayLike

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.link_frames import outline
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.model.tip_motion import stack
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.cameras import CameraPair, render, tag_plate

_DARK = "#9a6a00"
"""Orange for letters: dark enough to read on white."""

_LEVELS = {1: 1, 2: 1, 3: 1, 4: 1, 5: 1.7, 6: 1, 7: 1}
"""How far above (below) the arm the names of each row's axes stand, so that none meet."""

_BELOW = {"$z_4$": -0.045, "$x_5$": -0.045}
"""Axes that would hide another at the same place are drawn below it, m."""


def _demo() -> Arm:
    return Arm.load(folder("config") / "arm_demo.yaml")


def _axis(axes: Axes, at: np.ndarray, way: np.ndarray, color: str, name: str) -> None:
    """An axis as an arrow, its name beyond the head."""
    arrow(axes, at, at + way, color, width=2.5)
    axes.text(*(at + way * (1 + 0.2 / np.linalg.norm(way))), name, color=color, ha="center",
              va="center", fontsize=13)  # fmt: skip


def mdh_row(figure: Figure) -> None:
    """A row of the modified DH table in two views: along the previous x, and along its own z."""
    side, top = figure.subplots(1, 2)
    here, alpha = 1.7, np.radians(50)
    side.plot([0, 2.5], [0, 0], color=GREY, lw=1.2, ls="--")
    side.plot(*_oblique([[here, 0, 0], [here, 0, 1.0]]), color=GREY, lw=1.2, ls=":")
    for x in (0.0, here):
        side.plot(*_oblique([[x, 0, 0], [x, 0.75, 0]]), color=GREY, lw=1.2)
    side.text(*_oblique([[0.02, 0.95, 0]])[:, 0], "$y_{i-1}$", color="#555555", va="center")
    arrow(side, np.zeros(2), np.array([0.85, 0.0]), VERMILLION, width=2.5)
    side.text(0.8, 0.17, "$x_{i-1}$", color=VERMILLION, ha="center", va="center", fontsize=13)
    _axis(side, np.zeros(2), np.array([0.0, 0.9]), BLUE, "$z_{i-1}$")
    tilted = 1.15 * np.array([0.0, -np.sin(alpha), np.cos(alpha)])
    _axis(side, np.array([here, 0.0]), _oblique([tilted])[:, 0], BLUE, "$z_i$")
    turn = np.linspace(0, alpha, 30)
    arc = np.column_stack([np.full(30, here), -0.75 * np.sin(turn), 0.75 * np.cos(turn)])
    side.plot(*_oblique(arc), color=ORANGE, lw=2.5)
    side.text(here - 0.17, 0.83, "$\\alpha_{i-1}$", color=_DARK, fontsize=13, ha="center")
    _span(side, (0, -0.5), (here, -0.5), INK, "$a_{i-1}$", -0.24)
    side.set_title("1. $a$ along the previous $x$, $\\alpha$ about it")
    theta = np.radians(40)
    top.plot([0, 1.2], [0, 0], color=VERMILLION, lw=2, ls="--")
    top.text(1.27, 0, "$x_{i-1}$", color=VERMILLION, ha="left", va="center", fontsize=13)
    _axis(top, np.zeros(2), 1.2 * np.array([np.cos(theta), np.sin(theta)]), VERMILLION, "$x_i$")
    top.add_patch(Arc((0, 0), 1.5, 1.5, theta1=0, theta2=40, color=ORANGE, lw=2.5))
    top.text(0.85, 0.25, "$\\theta_i$", color=_DARK, fontsize=13)
    top.plot(0, 0, "o", ms=15, mfc="white", mec=BLUE, mew=2.5)
    top.plot(0, 0, "o", ms=5, color=BLUE)
    top.text(-0.14, -0.1, "$z_i$ points at you;\n$d_i$ lies along it", color=BLUE, ha="right",
             va="top")  # fmt: skip
    top.set_title("2. $d$ along the row's own $z$, $\\theta$ about it")
    for axes, middle in ((side, 1.1), (top, 0.1)):
        axes.set(xlim=(middle - 1.6, middle + 1.6), ylim=(-0.8, 1.35))
        bare(axes)


def _oblique(points: ArrayLike) -> np.ndarray:
    """(2, N) of points (N, 3): x to the right, z up, y away from the viewer."""
    x, y, z = np.array(points, dtype=float).T
    return np.array([x + 0.5 * y, z + 0.35 * y])


def mdh_frames(figure: Figure) -> None:
    """The demonstration's arm at its table's zero, with the z and the x of every row."""
    upper, lower = figure.subplots(2, 1, sharex=True)
    arm = _demo()
    model, q = Model(arm), np.zeros(arm.n)
    line, posture = outline(model, q), model.posture(unstack(q))
    for axes, letter, color in ((upper, "z", BLUE), (lower, "x", VERMILLION)):
        axes.plot(*line[:, [0, 2]].T, color=GREY, lw=8, alpha=0.4, solid_capstyle="round")
        for row, joint in zip(posture.chain.rows, arm.joints, strict=True):
            frame = posture.frames[row.frame]
            way = stack(frame.a if letter == "z" else frame.n)
            slides = " slides" if joint.type == "prismatic" and letter == "z" else ""
            name = f"${letter}_{joint.id}${slides}"
            _direction(axes, stack(frame.p)[[0, 2]], way, color, name, _LEVELS[joint.id])
        axes.set(xlim=(-0.12, 1.3), ylim=(-0.03, 0.31), ylabel="z of the base, m", yticks=[0, 0.2])
        axes.set_aspect("equal")
    upper.set_title("The demonstration's arm, all joints at 0: the $z$ axes of its DH rows")
    lower.set_title("The $x$ axes of its DH rows")
    lower.set_xlabel("x of the base, m")


def _direction(
    axes: Axes, at: np.ndarray, way: np.ndarray, color: str, name: str, level: float
) -> None:
    """An axis in the plane as an arrow; one across it as a point (towards you) or a cross."""
    flat = 0.085 * way[[0, 2]]
    aside = 0.034 * (-1 if name in _BELOW else level)
    if abs(way[1]) > 0.5:
        axes.plot(*at, "o", ms=13, mfc="white", mec=color, mew=2)
        axes.plot(*at, "." if way[1] < 0 else "x", ms=7, color=color, mew=2)
        axes.text(at[0], at[1] + 1.5 * aside, name, color=color, ha="center", va="center")
        return
    origin, at = at, at + np.array([0.0, _BELOW.get(name, 0.0)])
    axes.plot(*np.column_stack([origin, at]), color=color, lw=1.2, ls=":")
    arrow(axes, at, at + flat, color, width=2.5)
    if abs(way[2]) > 0.5:
        up = np.sign(way[2])
        axes.text(at[0] + 0.012, at[1] + flat[1] + 0.02 * up, name, color=color,
                  va="bottom" if up > 0 else "top")  # fmt: skip
    else:
        axes.text(*(at + flat + (0, aside)), name, color=color, ha="center", va="center")


def beams(figure: Figure) -> None:
    """Lengths of a telescope's beams, and a section."""
    side, cut = figure.subplots(1, 2, width_ratios=(2.6, 1))
    side.add_patch(Rectangle((0, -0.16), 3.0, 0.32, fc="#dbe7f1", ec=BLUE, lw=2))
    side.add_patch(Rectangle((1.4, -0.1), 2.9, 0.2, fc="#f6e3cf", ec=ORANGE, lw=2, ls="--"))
    side.plot([0, 0], [-0.3, 0.3], color=INK, lw=4)
    side.plot(4.3, 0, "o", ms=12, color=INK)
    _span(side, (0, 0.42), (3.0, 0.42), BLUE, "length_m: 3.0")
    _span(side, (3.0, 0.42), (4.3, 0.42), _DARK, "length_m: rest")
    _span(side, (0, -0.55), (4.3, -0.55), INK, "$d$ + joint value")
    _span(side, (1.4, -0.95), (4.3, -0.95), _DARK, "body_length_m: 2.9, holds the mass")
    side.set(xlim=(-0.2, 4.6), ylim=(-1.1, 1.05), title="A telescope along the $d$ of a DH row",
             xticks=[], yticks=[])  # fmt: skip
    side.spines[:].set_visible(False)
    angle = np.linspace(0, 2 * np.pi, 120)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    cut.add_patch(Polygon(ring, fc="#dbe7f1", ec=BLUE, lw=2))
    cut.add_patch(Polygon(0.75 * ring, fc="white", ec=BLUE, lw=2))
    _span(cut, (-1, -1.25), (1, -1.25), INK, "od_m", -0.38)
    _span(cut, (-0.75, 0), (0.75, 0), INK, "id_m")
    cut.set(xlim=(-1.3, 1.3), ylim=(-1.8, 1.3), title="Section of a tube")
    bare(cut)


def _span(
    axes: Axes, start: tuple[float, float], stop: tuple[float, float], color: str, text: str,
    aside: float = 0.06,
) -> None:  # fmt: skip
    """A dimension: a line with two heads and its name above, or below where `aside` is negative."""
    how = {"arrowstyle": "<|-|>", "color": color, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", stop, start, arrowprops=how)
    axes.text((start[0] + stop[0]) / 2, start[1] + aside, text, color=color, ha="center",
              va="bottom")  # fmt: skip


def marker_and_cameras(figure: Figure) -> None:
    """From above: arm, marker, cameras, hand-eye; beside it the marker, and an image of it."""
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1))
    plan, plate, image = (figure.add_subplot(grid[at]) for at in ((slice(None), 0), (0, 1), (1, 1)))
    arm, pair = _demo(), CameraPair(focal_px=640.0)
    _from_above(plan, outline(Model(arm), arm.mid), pair)
    tag, gap = 0.06, 0.012
    printed = tag_plate(tag, gap, 2, 2)
    wide, tall = (1e3 * side for side in printed.size_m)
    plate.imshow(printed.texture, cmap="gray", extent=(-wide / 2, wide / 2, -tall / 2, tall / 2))
    edge = 1e3 * (gap / 2 + tag)
    _span(plate, (-edge, -86), (-1e3 * gap / 2, -86), INK, "tag_m", -26)
    _span(plate, (-1e3 * gap / 2, 88), (1e3 * gap / 2, 88), INK, "gap_m", 6)
    arrow(plate, np.array([105.0, -60.0]), np.array([150.0, -60.0]), VERMILLION)
    arrow(plate, np.array([105.0, -60.0]), np.array([105.0, -15.0]), GREEN)
    plate.text(153, -60, "x", color=VERMILLION, va="center")
    plate.text(105, -10, "y", color=GREEN, ha="center")
    plate.text(100, 40, "z points at you", color=BLUE, va="center")
    plate.set(xlim=(-100, 230), ylim=(-120, 115), title="The marker")
    bare(plate)
    grey, _ = render(_mounted(arm), printed, pair, np.random.default_rng(0))
    image.imshow(grey[170:360, 300:600], cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    image.set(xticks=[], yticks=[], title="Part of the left camera's image")
    image.spines[:].set_visible(False)


def _from_above(axes: Axes, line: np.ndarray, pair: CameraPair) -> None:
    axes.plot(*line[:, [0, 1]].T, color=GREY, lw=6, solid_capstyle="round")
    left = np.array(pair.position_m[:2])
    half, far = 0.5 * pair.size[0] / pair.focal_px, 1.95
    for shift, name in ((0.0, "left"), (pair.baseline_m, "right")):
        eye = left + np.array([shift, 0.0])
        wedge = eye + np.array([[0.0, 0.0], [-half * far, far], [half * far, far]])
        axes.add_patch(Polygon(wedge, fc=ORANGE, alpha=0.15, lw=0))
        axes.add_patch(Rectangle(tuple(eye - (0.06, 0.12)), 0.12, 0.12, fc=INK))
        axes.text(eye[0], eye[1] - 0.18, name, ha="center", va="top")
    for way, color, name, at in (((0.3, 0), VERMILLION, "x", (0.3, -0.14)),
                                 ((0, 0.3), GREEN, "y", (-0.1, 0.25))):  # fmt: skip
        arrow(axes, np.zeros(2), np.array(way), color)
        axes.text(*at, name, color=color, ha="center")
    axes.text(-0.06, -0.05, "base", ha="right", va="top")
    arrow(axes, np.zeros(2), left, BLUE, dash="--", width=1.8)
    axes.text(0.3, -1.0, "hand_eye", color=BLUE, ha="right")
    tip = line[-1, :2]
    axes.plot(*tip, "s", color=BLUE, ms=12)
    axes.text(tip[0], tip[1] - 0.12, "marker on the tip", ha="center", va="top", color=BLUE)
    axes.set(xlim=(-0.45, 2.1), ylim=(-2.1, 0.45), title="From above")
    bare(axes)


def _mounted(arm: Arm) -> np.ndarray:
    """Pose (4, 4) of the marker on the tip, turned as config/simulated_arm.yaml mounts it."""
    text = (folder("config") / "simulated_arm.yaml").read_text("utf-8")
    marker = yaml.safe_load(text)["/**/simulated_arm"]["ros__parameters"]["marker"]
    on_tip = np.eye(4)
    on_tip[:3, :3] = cv2.Rodrigues(np.array(marker["mounting"]))[0]
    return TrueArm(arm).pose(arm.mid) @ on_tip
