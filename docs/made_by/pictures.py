"""Drawn pictures of the documentation, computed with the package where it can."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from longarm_comp.core.arm.arm import Arm
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm

GREY, BLUE, RED, GREEN = "#8a8f98", "#2b6cb0", "#c0392b", "#2f855a"


def draw(to: Path) -> None:
    """All of them, as SVG, each by its function's name."""
    to.mkdir(parents=True, exist_ok=True)
    style = {"svg.hashsalt": "longarm", "font.size": 10, "axes.spines.top": False,
             "axes.spines.right": False}  # fmt: skip
    with mpl.rc_context(style):
        for picture in (mdh_row, deflection, play, not_told_apart, hold_out, as_commanded):
            figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
            picture(axes)
            figure.savefig(to / f"{picture.__name__}.svg", metadata={"Date": None})
            plt.close(figure)


def deflection(axes: Axes) -> None:
    """The demonstration's arm, rigid and bent, seen from the cameras; the sag ten times larger."""
    arm = Arm.load(folder("config") / "arm_demo.yaml")
    bent = TrueArm(arm).points(arm.mid)[0]
    data = arm.model_dump(mode="json", exclude_defaults=True)
    for beam in data["links"]:
        beam["E_pa"] *= 1e4
    rigid = TrueArm(Arm.parse(data, "stiff")).points(arm.mid)[0]
    shown = rigid + 10.0 * (bent - rigid)
    axes.plot(1e3 * rigid[:, 0], 1e3 * rigid[:, 2], color=GREY, lw=4, label="rigid")
    axes.plot(1e3 * shown[:, 0], 1e3 * shown[:, 2], color=BLUE, lw=2, label="bent, sag x 10")
    sag = 1e3 * np.linalg.norm(bent[-1] - rigid[-1])
    axes.set(
        xlabel="x, mm", ylabel="z, mm", title=f"Under its own weight the tip sags by {sag:.1f} mm"
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False)


def play(axes: Axes) -> None:
    """A joint with play: where it stands depends on the side that it came from."""
    way = np.concatenate([np.linspace(0, 10, 200), np.linspace(10, 2, 200), np.linspace(2, 8, 200)])
    stands, at = [], 0.0
    for goal in way:
        at = min(max(at, goal - 0.5), goal + 0.5)
        stands.append(at)
    axes.plot([0, 10], [0, 10], color=GREY, lw=1, ls="--", label="without play")
    axes.plot(way, stands, color=BLUE, lw=2, label="with play of 1 deg")
    axes.set(
        xlabel="commanded, deg",
        ylabel="joint stands at, deg",
        title="Play: the side of arrival matters",
    )
    axes.legend(frameon=False)


def not_told_apart(axes: Axes) -> None:
    """Two causes that move the tip alike over the poses measured."""
    rng = np.random.default_rng(0)
    load = np.sort(rng.uniform(2, 6, 30))
    soft, droop = 0.8 * load, 0.8 * load - 0.02 * np.sin(load)
    axes.plot(load, soft + rng.normal(0, 0.12, 30), ".", color=GREY, label="measured")
    axes.plot(load, soft, color=BLUE, label="soft joint")
    axes.plot(load, droop, "--", color=RED, label="servo that gives way")
    axes.set(xlabel="load of the joint, N m", ylabel="error at the tip, mm",
             title="A set: both explain these poses, so neither is named alone")  # fmt: skip
    axes.legend(frameon=False)


def hold_out(axes: Axes) -> None:
    """A fit that follows the noise is good on its own poses only."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, 1, 16))
    y = 2 * x + rng.normal(0, 0.25, 16)
    kept = np.arange(16) % 4 == 2
    grid = np.linspace(x[~kept].min(), x[~kept].max(), 200)
    for degree, colour in ((1, BLUE), (9, RED)):
        fit = np.polynomial.Polynomial.fit(x[~kept], y[~kept], degree)
        off = np.abs(fit(x[kept]) - y[kept]).mean()
        label = f"{degree + 1} parameters: {off:.2f} mm on the hold-out"
        axes.plot(grid, fit(grid), color=colour, label=label)
    axes.plot(x[~kept], y[~kept], "o", color=GREY, label="fitted")
    axes.plot(x[kept], y[kept], "s", color=GREEN, label="hold-out: not seen by the fit")
    axes.set(
        xlabel="pose",
        ylabel="error, mm",
        ylim=(-1, 3.5),
        title="Judged on poses that were not fitted",
    )
    axes.legend(frameon=False)


def as_commanded(axes: Axes) -> None:
    """The expected error is taken off the target."""
    target, error = np.array([2.0, 1.5]), np.array([0.5, -0.9])
    for start, color, label in (
        (target, RED, "not compensated"),
        (target - error, GREEN, "compensated"),
    ):
        axes.annotate(
            "", start + error, start, arrowprops={"arrowstyle": "->", "color": color, "lw": 2}
        )
        axes.plot(*start, "o", color=color, label=f"commanded, {label}")
    axes.plot(*target, "+", color="black", ms=16, mew=2, label="target")
    axes.set(xlim=(0.5, 4.5), ylim=(0, 3), xticks=[], yticks=[],
             title="pseudo-target = target - expected error")  # fmt: skip
    axes.legend(frameon=False, loc="upper right")


def mdh_row(axes: Axes) -> None:
    """A row of the modified DH table, with alpha = 0, in the plane of both x."""
    theta = np.radians(35.0)
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    here = np.array([1.6, 0.0])
    for at, axis, name in ((np.zeros(2), np.eye(2), "i-1"), (here, turn.T, "i")):
        for k, letter in enumerate("xy"):
            axes.annotate("", at + 0.8 * axis[k], at, arrowprops={"arrowstyle": "->", "lw": 2,
                          "color": (RED, GREEN)[k]})  # fmt: skip
            axes.text(
                *(at + 0.9 * axis[k] + (0.0, -0.12 * (1 - k))),
                f"${letter}_{{{name}}}$",
                ha="center",
                va="center",
            )
        axes.plot(*at, "o", color=BLUE, ms=9)
        axes.text(at[0] - 0.05, at[1] - 0.25, f"$z_{{{name}}}$", ha="center")
    axes.plot([0, here[0]], [0, 0], color=GREY, lw=1, ls="--")
    axes.text(0.95, 0.06, "$a$", ha="center")
    angle = np.linspace(0, theta, 30)
    axes.plot(here[0] + 0.5 * np.cos(angle), 0.5 * np.sin(angle), color=GREY)
    axes.text(here[0] + 0.6, 0.17, "$\\theta$", ha="center")
    axes.plot([here[0], here[0] + 1], [0, 0], color=GREY, lw=1, ls=":")
    axes.set(xlim=(-0.4, 3.2), ylim=(-0.5, 1.2), xticks=[], yticks=[],
             title="a along $x_{i-1}$, alpha about it; theta about $z_i$, d along it")  # fmt: skip
    axes.set_aspect("equal")
    for spine in axes.spines.values():
        spine.set_visible(False)
