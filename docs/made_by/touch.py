"""Pictures of docs/touch.md: the parts to print, and an arm that touches one point."""

import math
from pathlib import Path

import numpy as np
from drawing import BLUE, GREY, INK, ORANGE, VERMILLION, arrow, bare
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.placed_model import place_frames, placement_terms
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import outline
from longarm_comp.sessions.read import read_session

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "panda_touch"
SHEET_MM = (180.0, 126.0)
BALL_MM, STUD_MM, MOUTH_MM, GAP_MM = 20.0, 6.0, 18.0, 50.0
PLATE_MM = (100.0, 60.0, 15.0)
INCH_MM = 25.4


def touch_parts(figure: Figure) -> None:
    """Plate with two sockets, its section with the ball, and the ball's stud: 1 mm is 1 mm."""
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, SHEET_MM[0]), ylim=(0, SHEET_MM[1]))
    bare(axes)
    _plate(axes, 10.0, 56.0)
    _section(axes, 10.0, 14.0)
    _ball(axes, 150.0, 81.0)
    axes.plot([125, 175], [8, 8], color=INK, lw=1.2)
    for x in (125, 175):
        axes.plot([x, x], [6, 10], color=INK, lw=1.2)
    axes.text(150, 10, "50 mm: measure it on your print", ha="center", fontsize=8)


def _plate(axes: Axes, x: float, y: float) -> None:
    width, height, _ = PLATE_MM
    axes.add_patch(Rectangle((x, y), width, height, fc="none", ec=INK, lw=1.5))
    for side in (-0.5, 0.5):
        middle = (x + width / 2 + side * GAP_MM, y + height / 2)
        axes.add_patch(Circle(middle, MOUTH_MM / 2, fc="#eeeeee", ec=INK, lw=1.5))
        axes.plot(*middle, "+", color=VERMILLION, ms=9)
    for dx in (8.0, width - 8.0):
        for dy in (8.0, height - 8.0):
            axes.add_patch(Circle((x + dx, y + dy), 3.2, fc="none", ec=GREY, lw=1.2))
    left = x + width / 2 - GAP_MM / 2
    for end, start in ((left, left + 20), (left + GAP_MM, left + GAP_MM - 20)):
        arrow(axes, np.array([start, y + 46]), np.array([end, y + 46]), INK, width=1.0)
    axes.text(x + width / 2, y + 46, f"{GAP_MM:g}", ha="center", va="center", fontsize=10)
    axes.text(x, y + height + 2, "plate from above, lengths in mm; 4 holes for M6", fontsize=9)
    axes.text(left, y + 18, f"cone 90°, ⌀ {MOUTH_MM:g}", ha="center", va="top", fontsize=8)


def _section(axes: Axes, x: float, y: float) -> None:
    width, _, thick = PLATE_MM
    mouth, left = MOUTH_MM / 2, x + width / 2 - GAP_MM / 2
    right, top = left + GAP_MM, y + thick
    cut = [(x, y), (x + width, y), (x + width, top)]
    for middle in (right, left):
        cut += [(middle + mouth, top), (middle, top - mouth), (middle - mouth, top)]
    axes.add_patch(Polygon([*cut, (x, top)], fc="#dddddd", ec=INK, lw=1.2))
    above = BALL_MM / 2 * math.sqrt(2.0) - mouth
    _stud(axes, left, top + above, math.radians(65), 19.0)
    axes.text(
        right, y - 2, f"section; the plate is {thick:g} thick", ha="center", va="top", fontsize=9
    )
    said = f"the ball's centre stays {above:.1f} above the plate,\nhowever the arm turns it"
    axes.text(left + 18, top + 3, said, fontsize=8)


def _stud(axes: Axes, x: float, y: float, angle: float, length: float) -> None:
    along = np.array([math.cos(angle), math.sin(angle)])
    side = STUD_MM / 2 * np.array([-along[1], along[0]])
    corners = np.array([side, side + length * along, length * along - side, -side])
    axes.add_patch(Polygon(corners + np.array([x, y]), fc="white", ec=INK, lw=1.2))
    axes.add_patch(Circle((x, y), BALL_MM / 2, fc="#c8d8ea", ec=BLUE, lw=1.5))
    axes.plot(x, y, "+", color=VERMILLION, ms=9)


def _ball(axes: Axes, x: float, y: float) -> None:
    _stud(axes, x, y, math.pi / 2, 35.0)
    said = f"steel ball ⌀ {BALL_MM:g}\non a rod M{STUD_MM:g}, glued"
    axes.text(x, y - 12, said, ha="center", va="top", fontsize=9)
    axes.text(x + 5, y + 30, "to the hand", fontsize=8, color=GREY)


def touch_postures(figure: Figure) -> None:
    """Rows of a real arm that all touched one socket."""
    arm = Arm.load(EXAMPLE / "arm.yaml")
    session = read_session(EXAMPLE / "panda_3.csv", arm)
    start = place_frames(declared_model(arm).plus(*placement_terms(arm, session)), session)
    known = fit_model(start, session).model
    names, counts = np.unique(session.labels["touch"], return_counts=True)
    rows = np.flatnonzero(session.labels["touch"] == names[np.argmax(counts)])
    tips = known.tip(session.q[rows])
    axes = figure.subplots()
    for row in rows[:: max(len(rows) // 6, 1)][:6]:
        points = 1e3 * np.vstack([outline(known, session.q[row]), known.tip(session.q[row])])
        axes.plot(*points[:, [0, 2]].T, color=BLUE, lw=2.5, alpha=0.55)
    socket = 1e3 * tips.mean(axis=0)
    axes.plot(*socket[[0, 2]], "o", ms=12, mfc="none", mec=VERMILLION, mew=2, label="the socket")
    axes.plot(0, 0, "s", color=ORANGE, ms=9, label="base")
    off = 1e3 * np.linalg.norm(tips - tips.mean(axis=0), axis=1).mean()
    said = (
        f"Six of {len(rows)} touches of one socket; by the data sheet they are {off:.1f} mm off it"
    )
    axes.set(xlabel="x, mm", ylabel="z, mm", title=said)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="upper left")
