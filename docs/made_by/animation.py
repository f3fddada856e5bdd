"""The demonstration as a short animation, from what it wrote."""

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from demonstration import RUNS, Demonstration
from drawing import GREY, INK, STYLE, VERMILLION, arrow
from matplotlib.axes import Axes
from PIL import Image

import longarm_comp as la
from longarm_comp.core.effects.catalogue import registered
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.link_frames import outline
from longarm_comp.core.model.model import unstack
from longarm_comp.core.model.tip_motion import stack
from longarm_comp.jobs.demo import DECLARED, FOUND, ORIGINAL

ERROR_TIMES = 10.0
STOPS = 9
"""Targets of each run at which the arm is shown; the errors of all are drawn."""


@dataclass
class Scene:
    """What a frame shows.

    Attributes:
        step: what is being done, in words.
        q: (n,) commanded joints.
        target: (3,) m, or None between targets.
        tip: (3,) where the tip is, m, or None.
        done: how many targets of each run have their error drawn.
        seen: (N, 3) measured tips of the session so far, m.
        note: what the diagnosis says; guilty: joints that it names, counted from 1.
        milliseconds: how long it is shown.
    """

    step: str
    q: np.ndarray
    target: np.ndarray | None = None
    tip: np.ndarray | None = None
    done: dict[str, int] = field(default_factory=dict)
    seen: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    note: str = ""
    guilty: tuple[int, ...] = ()
    milliseconds: int = 90


def write_animation(demo: Demonstration, path: Path) -> None:
    """Draw every scene and write them as one WebP, without loss."""
    scenes = list(story(demo))
    with mpl.rc_context(STYLE):
        frames = [_drawn(demo, scene) for scene in scenes]
    frames[0].save(path, save_all=True, append_images=frames[1:], loop=0, lossless=True,
                   duration=[scene.milliseconds for scene in scenes], method=6)  # fmt: skip


def story(demo: Demonstration) -> Iterator[Scene]:
    """The scenes in their order."""
    models = {ORIGINAL: la.Model(demo.arm), DECLARED: declared_model(demo.arm), FOUND: demo.found}
    words = {
        ORIGINAL: "1. Without compensation the arm bends, and its tip misses the targets",
        DECLARED: "2. The declared deflection is compensated",
        FOUND: "5. The same targets, compensated with the effects found",
    }
    done: dict[str, int] = {}
    for run in (ORIGINAL, DECLARED):
        yield from _run(demo, run, models[run], words[run], done)
    q, xyz = demo.session.q, demo.session.xyz
    for k in range(0, len(q), 9):
        yield Scene(f"3. Cameras measure other poses: {min(k + 9, len(q))} of {len(q)}", q[k],
                    done=dict(done), seen=xyz[:k + 9])  # fmt: skip
    note, guilty = _diagnosis(demo)
    step = "4. The diagnosis finds the effects that the model lacks"
    yield Scene(step, demo.arm.mid, done=dict(done), seen=xyz, milliseconds=1200)
    yield Scene(step, demo.arm.mid, done=dict(done), note=note, guilty=guilty, milliseconds=3800)
    yield from _run(demo, FOUND, models[FOUND], words[FOUND], done)
    means = " → ".join(_short(demo.missed_mm(run).mean()) for run in (ORIGINAL, DECLARED, FOUND))
    last = demo.joints(models[FOUND])[-1]
    yield Scene(f"Mean error of the tip: {means} mm", last, demo.targets[-1], demo.true(FOUND)[-1],
                dict(done), milliseconds=4500)  # fmt: skip


def _run(
    demo: Demonstration, run: str, model: la.Model, step: str, done: dict[str, int]
) -> Iterator[Scene]:
    """One run over the targets, with two frames on the way between the stops."""
    q, true = demo.joints(model), demo.true(run)
    stops = np.linspace(0, len(q) - 1, STOPS).round().astype(int)
    at = demo.arm.mid
    for k in stops:
        for share in (0.35, 0.75):
            yield Scene(step, at + share * (q[k] - at), demo.targets[k], done=dict(done))
        at, done[run] = q[k], int(k) + 1
        yield Scene(step, at, demo.targets[k], true[k], dict(done), milliseconds=320)


def _diagnosis(demo: Demonstration) -> tuple[str, tuple[int, ...]]:
    """What the report's findings say, in a mechanic's words, and their joints."""
    report = json.loads((demo.folder / "report.json").read_text("utf-8"))
    lines, guilty = [], set()
    for found in report["findings"]:
        names = [registered()[name].title for name in found["set"] or [found["effect"]]]
        joints = [int(place.split()[1]) for place in found["where"] if place.startswith("joint")]
        lines.append(f"{' or '.join(names)}, joints {', '.join(map(str, joints))}")
        guilty |= {*joints}
    held = {row["model"]: row["mean_mm"] for row in report["held_out"]["rows"]}
    change = f"{held['calibrated']:.2f} → {held['with_effects']:.2f} mm"
    return "\n".join([*lines, f"error at held-out poses: {change}"]), tuple(sorted(guilty))


def _drawn(demo: Demonstration, scene: Scene) -> Image.Image:
    figure = plt.figure(figsize=(8.2, 3.9))
    side = figure.add_axes((0.02, 0.03, 0.53, 0.83))
    errors = figure.add_axes((0.645, 0.155, 0.335, 0.685))
    figure.text(0.02, 0.93, scene.step, fontsize=13, weight="bold", va="center")
    _arm(side, demo, scene)
    _errors(errors, demo, scene)
    held = io.BytesIO()
    figure.savefig(held, format="png", dpi=100)
    plt.close(figure)
    return Image.open(held).convert("RGB").quantize(64, dither=Image.Dither.NONE).convert("RGB")


def _arm(axes: Axes, demo: Demonstration, scene: Scene) -> None:
    """From the side, true size: straight and bent arm; the error enlarged."""
    straight, bent = outline(la.Model(demo.arm), scene.q), outline(demo.found, scene.q)
    axes.plot(*straight[:, [0, 2]].T, color=GREY, lw=2, ls="--")
    axes.plot(*bent[:, [0, 2]].T, color="#333333", lw=4, solid_capstyle="round", label="bent")
    axes.plot(0, 0, "s", color=INK, ms=12)
    axes.plot(*scene.seen[:, [0, 2]].T, ".", color="#009E73", ms=4)
    if scene.target is not None:
        axes.plot(*scene.target[[0, 2]], "+", color=INK, ms=18, mew=2.5)
    if scene.target is not None and scene.tip is not None:
        head = scene.target + ERROR_TIMES * (scene.tip - scene.target)
        if np.linalg.norm(head - scene.target) > 0.01:
            arrow(axes, scene.target[[0, 2]], head[[0, 2]], VERMILLION)
    for row in scene.guilty:
        x, z = _place(demo, scene.q, row)
        axes.plot(x, z, "o", ms=20, mfc="none", mec=VERMILLION, mew=2.5)
        axes.text(x, z + 0.055, str(row), color=VERMILLION, ha="center", weight="bold")
    legend = f"dashed: declared, solid: real arm, arrow: error × {ERROR_TIMES:g}"
    axes.text(0.1, -0.34, scene.note or legend, va="bottom", fontsize=11 if scene.note else 10)
    axes.set(xlim=(-0.06, 1.24), ylim=(-0.36, 0.5), aspect="equal")
    axes.axis("off")


def _place(demo: Demonstration, q: np.ndarray, row: int) -> np.ndarray:
    """(2,) x and z of a row's frame, m."""
    posture = demo.found.posture(unstack(q))
    at: np.ndarray = stack(posture.frames[posture.chain.rows[row - 1].frame].p)[[0, 2]]
    return at


def _errors(axes: Axes, demo: Demonstration, scene: Scene) -> None:
    """Distance of the true tip from each target so far."""
    for run, count in scene.done.items():
        color, sign, words = RUNS[run]
        missed = demo.missed_mm(run)[:count]
        axes.plot(np.arange(1, count + 1), missed, sign, color=color, ms=4.5)
        axes.axhline(missed.mean(), color=color, lw=1)
        aside, side = _LABELS[run]
        said = f"{words}: mean {_short(missed.mean())} mm"
        axes.text(40, aside * missed.mean(), said, ha="right", va=side, fontsize=10)
    axes.set(yscale="log", ylim=(0.001, 100), xlim=(0, 41), xlabel="target")
    axes.set_xticks([1, 10, 20, 30, 40])
    axes.set_yticks([0.001, 0.01, 0.1, 1, 10, 100], ["0.001", "0.01", "0.1", "1", "10", "100"])
    axes.set_title("true error of the tip, mm", fontsize=11)


_LABELS = {ORIGINAL: (1.35, "bottom"), DECLARED: (0.72, "top"), FOUND: (3.0, "bottom")}
"""Where the words of each run stand: a factor from its mean, and on which side."""


def _short(mm: float) -> str:
    return f"{mm:.1f}" if mm >= 1 else f"{mm:.2f}"
