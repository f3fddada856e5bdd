"""Pictures of one demonstration, from the folder that `longarm demo` wrote."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from drawing import BLUE, GREEN, GREY, INK, ORANGE, VERMILLION, arrow
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import longarm_comp as la
from longarm_comp.core.model.link_frames import exaggerate_sag, outline
from longarm_comp.jobs.demo import DECLARED, FOUND, LEARNED, ORIGINAL
from longarm_comp.share import folder

RUNS = {
    ORIGINAL: (VERMILLION, "X", "not compensated"),
    DECLARED: (ORANGE, "^", "declared deflection"),
    FOUND: (BLUE, "o", "effects found"),
    LEARNED: (GREEN, "D", "and the network"),
}
"""Colour, sign and words of each run."""

_BENT_TIMES = 8.0


@dataclass(frozen=True)
class Demonstration:
    """What a demonstration wrote."""

    folder: Path

    @cached_property
    def arm(self) -> la.Arm:
        """The declared arm."""
        return la.Arm.load(folder("config") / "arm_demo_steps.yaml")

    @cached_property
    def found(self) -> la.Model:
        """The model with what the diagnosis found."""
        return la.load_model(self.folder / "model.yaml", self.arm)

    @cached_property
    def session(self) -> la.Session:
        """The collected session."""
        return la.read_session(self.folder / "session", self.arm)

    @cached_property
    def targets(self) -> np.ndarray:
        """(N, 3) m."""
        return np.array(self._steps[f"run: {ORIGINAL}"]["target"])

    @cached_property
    def _steps(self) -> dict[str, Any]:
        return dict(json.loads((self.folder / "steps.json").read_text("utf-8")))

    @property
    def runs(self) -> list[str]:
        """Those that it has: the last one where a network is put to work."""
        return [run for run in RUNS if f"run: {run}" in self._steps]

    def true(self, run: str) -> np.ndarray:
        """(N, 3) where the simulation's tip came to rest, m."""
        return np.array(self._steps[f"run: {run}"]["true"])

    def missed_mm(self, run: str) -> np.ndarray:
        """(N,) distance of the true tip from its target, mm."""
        return 1e3 * np.linalg.norm(self.true(run) - self.targets, axis=1)

    def joints(self, model: la.Model) -> np.ndarray:
        """(N, n) joints that bring a model's tip to the targets, all from the middle."""
        return la.compensate(model, self.targets, run_up=False).command


def bent_and_straight(demo: Demonstration) -> Callable[[Figure], None]:
    """The arm at the target that it misses most: straight, and as the found model bends it."""

    def draw(figure: Figure) -> None:
        side, near = figure.subplots(1, 2, width_ratios=(1.75, 1))
        worst = int(demo.missed_mm(ORIGINAL).argmax())
        target = demo.targets[worst]
        q = demo.joints(la.Model(demo.arm))[worst]
        straight, bent = outline(la.Model(demo.arm), q), outline(demo.found, q)
        moves = np.linalg.norm(np.diff(straight, axis=0), axis=1) > 1e-3
        kept = [0, *np.flatnonzero(moves) + 1, -1]  # one station at each place
        straight, bent = straight[kept], bent[kept]
        shown = exaggerate_sag(bent, straight, _BENT_TIMES)
        _arm(side, straight, GREY, 6, (0, (1.6, 0.5)), "as declared: straight")
        _arm(side, shown, BLUE, 4, "-", f"real arm, error × {_BENT_TIMES:g}")
        side.plot(*(1e3 * target[[0, 2]]), "+", color=INK, ms=20, mew=2.5, label="target")
        side.plot(0, 0, "s", color=INK, ms=12)
        arrow(side, 1e3 * target[[0, 2]], 1e3 * shown[-1, [0, 2]], VERMILLION)
        side.set(xlabel="x, mm", ylabel="z, mm", title="A long arm bends, and its joints yield")
        side.set_aspect("equal", adjustable="datalim")
        side.legend(loc="lower left")
        _tips(near, demo, worst)

    return draw


def _arm(axes: Axes, line: np.ndarray, color: str, width: float, dash: Any, label: str) -> None:
    axes.plot(*(1e3 * line[:, [0, 2]].T), color=color, lw=width, ls=dash, label=label)


def _tips(axes: Axes, demo: Demonstration, at: int) -> None:
    """Where the tip came to rest at one target, in true size."""
    axes.plot(0, 0, "+", color=INK, ms=26, mew=2.5)
    for run in demo.runs:
        color, sign, words = RUNS[run]
        off = 1e3 * (demo.true(run)[at] - demo.targets[at])
        size = 11 if run in (ORIGINAL, DECLARED) else 8
        axes.plot(off[0], off[2], sign, color=color, ms=size, mfc="none" if size == 8 else color,
                  mew=2, label=f"{words}: {np.linalg.norm(off):.2f} mm")  # fmt: skip
    low = 1e3 * float((demo.true(ORIGINAL)[at] - demo.targets[at])[2])
    axes.set(xlim=(-0.75 * abs(low), 0.75 * abs(low)), ylim=(1.65 * low, 0.25 * abs(low)),
             xlabel="x from the target, mm", ylabel="z from the target, mm",
             title="The tip at this target, true size")  # fmt: skip
    axes.legend(loc="lower center", frameon=True, framealpha=1)


RUNGS = {
    "nominal": ("as declared", GREY, ""),
    "frames_only": ("+ base and tip placed", ORANGE, "//"),
    "calibrated": ("+ geometry calibrated", GREEN, "xx"),
    "with_effects": ("+ effects found", BLUE, ".."),
    "with_network": ("+ network", VERMILLION, "++"),
}
"""Words, colour and hatch of the models of a ladder."""


def ladder(demo: Demonstration) -> Callable[[Figure], None]:
    """Held-out errors of ever fuller models, a bar each."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        report = json.loads((demo.folder / "report.json").read_text("utf-8"))["held_out"]
        rows = [row for row in report["rows"] if row["model"] in RUNGS]
        for k, row in enumerate(rows):
            _, color, hatch = RUNGS[row["model"]]
            axes.barh(k, row["mean_mm"], color=color, hatch=hatch, ec="white", height=0.7)
            axes.plot([row["mean_mm"], row["max_mm"]], [k, k], color=INK, lw=1.5)
            axes.plot(row["max_mm"], k, "|", color=INK, ms=14, mew=2)
            axes.text(1.15 * row["max_mm"], k, f"{row['mean_mm']:.2f} mm", va="center")
        axes.set(xscale="log", xlim=(0.01, 60), xlabel="error, mm: mean (bar), largest (line)",
                 title=f"Held-out errors of the demonstration, {report['n']} poses")  # fmt: skip
        axes.set_xticks([0.1, 1, 10], ["0.1", "1", "10"])
        axes.set_yticks(range(len(rows)), [RUNGS[row["model"]][0] for row in rows])
        axes.invert_yaxis()

    return draw
