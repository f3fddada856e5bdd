"""One picture for each idea of docs/glossary.md."""

from pathlib import Path

import numpy as np
from drawing import BLUE, GREEN, GREY, INK, ORANGE, VERMILLION, arrow, bare
from matplotlib.figure import Figure

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import exaggerate_sag, outline
from longarm_comp.core.model.model import Model
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm

_SAG_TIMES = 8.0


def deflection(figure: Figure) -> None:
    """The demonstration's arm: declared straight, predicted by the model, integrated as rods."""
    axes = figure.subplots()
    arm = Arm.load(folder("config") / "arm_demo.yaml")
    straight, bent = outline(Model(arm), arm.mid), outline(declared_model(arm), arm.mid)
    true = TrueArm(arm).tip(arm.mid)
    shown = 1e3 * exaggerate_sag(bent, straight, _SAG_TIMES)
    tip = 1e3 * exaggerate_sag(true[None], straight[-1:], _SAG_TIMES)[0]
    axes.plot(*(1e3 * straight[:, [0, 2]].T), color=GREY, lw=5, ls=(0, (2, 0.6)), label="straight")
    axes.plot(*shown[:, [0, 2]].T, color=BLUE, lw=3, label=f"bent, sag × {_SAG_TIMES:g}")
    axes.plot(*tip[[0, 2]], "o", ms=11, mfc="none", mec=VERMILLION, mew=2,
              label="tip of the simulated arm (elastic rods)")  # fmt: skip
    sag, off = np.linalg.norm(bent[-1] - straight[-1]), np.linalg.norm(bent[-1] - true)
    axes.set(xlabel="x, mm", ylabel="z, mm",
             title=f"The tip sags by {1e3 * sag:.1f} mm under the arm's weight; "
                   f"model and simulation agree to {1e6 * off:.0f} µm")  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="lower left")


def play(figure: Figure) -> None:
    """A joint with play: where it stands depends on the side that it came from."""
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    width, gap = 10.0, 1.2
    stands, at = [], 0.0
    way = np.concatenate([np.linspace(0, width, 200), np.linspace(width, 0, 200)])
    for goal in way:
        at = min(max(at, goal - gap / 2), goal + gap / 2)
        stands.append(at)
    left.plot([0, width], [0, width], color=GREY, lw=1.5, ls="--")
    left.plot(way[:200], stands[:200], color=BLUE, lw=3, label="arrives from below")
    left.plot(way[200:], stands[200:], color=ORANGE, lw=3, ls=(0, (4, 1)), label="from above")
    left.set(xlabel="commanded, deg", ylabel="the joint stands at, deg", aspect="equal",
             title="Play of 1.2 deg")  # fmt: skip
    left.legend(loc="lower right")
    right.set(title="One command, two places of the tip")
    for sign, color, dash in ((-1, BLUE, "-"), (1, ORANGE, (0, (4, 1)))):
        angle = np.radians(20 + sign * 7)
        right.plot([0, np.cos(angle)], [0, np.sin(angle)], color=color, lw=4, ls=dash)
        turn = np.radians(20 + sign * np.linspace(28, 9, 30))
        right.plot(0.75 * np.cos(turn), 0.75 * np.sin(turn), color=color, lw=1.5)
        arrow(right, 0.75 * np.array([np.cos(turn[-2]), np.sin(turn[-2])]),
              0.75 * np.array([np.cos(turn[-1]), np.sin(turn[-1])]), color, width=1.5)  # fmt: skip
    commanded = np.radians(20)
    right.plot([0, np.cos(commanded)], [0, np.sin(commanded)], color=GREY, lw=1.5, ls="--")
    right.text(1.03 * np.cos(commanded), np.sin(commanded), "commanded", color=INK, va="center")
    right.plot(0, 0, "o", color=INK, ms=10)
    right.set(xlim=(-0.1, 1.45), ylim=(-0.3, 0.85))
    bare(right)


def not_told_apart(figure: Figure) -> None:
    """Two causes that move the tip alike over the measured poses, and differ elsewhere."""
    axes = figure.subplots()
    rng = np.random.default_rng(0)
    load = np.linspace(0, 10, 200)
    seen = np.sort(rng.uniform(2, 5, 26))

    def droop(torque: np.ndarray) -> np.ndarray:
        return 0.8 * np.clip(torque, 0, 5.2) + 0.03 * np.sin(2 * torque)

    measured = 0.8 * seen + rng.normal(0, 0.12, seen.size)
    axes.axvspan(2, 5, color=GREY, alpha=0.18, lw=0)
    axes.axvspan(7, 10, fc="none", ec=GREY, hatch="//", alpha=0.35, lw=0)
    axes.text(3.5, 7.4, "poses measured", ha="center")
    axes.text(8.4, 2.9, "poses that\nwould decide", ha="center", backgroundcolor="white")
    axes.plot(load, 0.8 * load, color=BLUE, lw=2.5, label="soft joint")
    axes.plot(load, droop(load), color=VERMILLION, lw=2.5, ls=(0, (4, 1)),
              label="servo that gives way, up to its stop")  # fmt: skip
    axes.plot(seen, measured, ".", color=INK, ms=7, label="measured")
    axes.set(xlabel="load of the joint, N m", ylabel="error at the tip, mm", ylim=(0, 8),
             xlim=(0, 10), title="A set: two effects explain the measured poses")  # fmt: skip
    axes.legend(loc="lower right", frameon=True, facecolor="white", framealpha=1)


def hold_out(figure: Figure) -> None:
    """A fit that follows the noise is good on its own poses only."""
    axes = figure.subplots()
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, 1, 16))
    y = 2 * x + rng.normal(0, 0.25, 16)
    kept = np.arange(16) % 4 == 2
    grid = np.linspace(x[~kept].min(), x[~kept].max(), 300)
    for degree, colour, dash in ((1, BLUE, "-"), (9, VERMILLION, (0, (4, 1)))):
        fit = np.polynomial.Polynomial.fit(x[~kept], y[~kept], degree)
        own, off = (np.abs(fit(x[rows]) - y[rows]).mean() for rows in (~kept, kept))
        label = f"{degree + 1} parameters: {own:.2f} mm fitted, {off:.2f} mm held out"
        axes.plot(grid, fit(grid), color=colour, ls=dash, lw=2, label=label)
    axes.plot(x[~kept], y[~kept], "o", color=GREY, ms=8, label="fitted")
    axes.plot(x[kept], y[kept], "s", color=GREEN, ms=9, label="held out: not used in the fit")
    axes.set(xlabel="pose", ylabel="error, mm", xticks=[], ylim=(-0.6, 5.2),
             title="A model is judged by poses that were not used in its fit")  # fmt: skip
    axes.legend(loc="upper left")


def pseudo_target(figure: Figure) -> None:
    """The expected error is taken off the target."""
    axes = figure.subplots()
    target, error = np.array([2.0, 1.5]), np.array([0.55, -1.0])
    arrow(axes, target, target + error, VERMILLION)
    arrow(axes, target - error, target, BLUE)
    axes.plot(*target, "+", color=INK, ms=22, mew=2.5)
    axes.plot(*(target + error), "X", color=VERMILLION, ms=12)
    axes.plot(*(target - error), "s", mfc="none", mec=BLUE, ms=12, mew=2.5)
    notes = (
        (target, "target", (0.22, 0.0)),
        (target + error, "without compensation:\nthe tip sags below the target", (0.22, 0.05)),
        (target - error, "pseudo-target: the joints are computed for this point", (0.22, 0.0)),
    )
    for at, text, aside in notes:
        axes.text(*(at + aside), text, va="center")
    axes.text(*(target + 0.5 * error + (-0.12, 0)), "expected error", ha="right", va="center",
              color=VERMILLION)  # fmt: skip
    axes.text(*(target - 0.5 * error + (-0.12, 0)), "the arm sags onto the target", ha="right",
              va="center", color=BLUE)  # fmt: skip
    axes.set(xlim=(-0.2, 5.4), ylim=(0.1, 2.9), title="pseudo-target = target − expected error")
    bare(axes)


def commanded_and_seen(figure: Figure) -> None:
    """What the cameras add is in the error as seen, and not in the error as commanded."""
    axes = figure.subplots()
    target, true, seen = np.array([1.2, 1.5]), np.array([2.2, 0.95]), np.array([3.0, 1.75])
    arrow(axes, target, true, BLUE)
    arrow(axes, true, seen, ORANGE, dash="--")
    arrow(axes, target, seen, GREY, width=1.5)
    axes.plot(*target, "+", color=INK, ms=22, mew=2.5)
    axes.plot(*true, "o", color=BLUE, ms=12)
    axes.plot(*seen, "o", mfc="none", mec=ORANGE, ms=13, mew=2.5)
    axes.text(target[0], target[1] + 0.22, "target", ha="center")
    axes.text(true[0], true[1] - 0.25, "the tip", ha="center", color=BLUE)
    axes.text(seen[0] + 0.15, seen[1] + 0.05, "where the cameras see the tip", va="center")
    axes.text(1.45, 1.02, "as commanded:\nthe arm's own error", ha="right", color=BLUE, va="center")
    axes.text(2.0, 1.78, "as seen", ha="center", color="#555555")
    axes.text(2.75, 1.2, "the measuring side (scale, hand-eye, lens):\nfitted, never compensated",
              va="center")  # fmt: skip
    axes.set(xlim=(-0.1, 5.2), ylim=(0.45, 2.2),
             title="One move: the error as commanded, and as the cameras see it")  # fmt: skip
    bare(axes)


def how_many_poses(figure: Figure) -> None:
    """The table of docs/studies.md, "Which poses to measure", where the effect is known."""
    axes = figure.subplots()
    rows = [line.replace("*", "").split("|")[1:-1] for line in _studies() if "| known |" in line]
    poses, *errors = np.array([[float(v) for v in row[1:]] for row in rows]).T
    kinds = (("grid", GREY, "s", "--"), ("Sobol", ORANGE, "^", "-."), ("I-optimal", BLUE, "o", "-"))
    for (name, color, sign, dash), mm in zip(kinds, errors, strict=True):
        axes.plot(poses, mm, dash, marker=sign, color=color, lw=2, ms=8, label=name)
    axes.set(xlabel="poses measured", ylabel="error of the true tip, mm", ylim=(0, 0.27),
             title="Error after a calibration with a known effect, by kind of plan")  # fmt: skip
    axes.set_xticks(poses, [f"{n:g}" for n in poses])
    axes.legend(title="plan of poses")


def _studies() -> list[str]:
    return (Path(__file__).resolve().parents[1] / "studies.md").read_text("utf-8").splitlines()
