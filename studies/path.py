"""Planned paths after compensation: lines, arcs and plans of joints, at three speeds.

A planner plans for the declared arm, which does not bend, with a way-point every `PERIOD_S`.  The
true arm follows the plan as it is, and as `compensate_path` changes it; between way-points the
controller's own cubic is followed.  Deviations are of the true tip from the planned curve, at rest
in every place (no inertia: `longarm study ringing`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.cli import options, outputs
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.compensate import physics_of
from longarm_comp.core.compensation.path import CompensatedPath, compensate_path
from longarm_comp.core.compensation.planned_path import PlannedPath
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import effect_class
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.math.cubic_path import CubicPath, smooth_slopes
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import State, TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.catalogue import hidden
from longarm_comp.sim.hidden.drives import FrictionHysteresis
from studies.commands import (
    Figures,
    Show,
    arm_option,
    arms_option,
    each_arm,
    study_command,
    whole_number,
)
from studies.loop import append_line, read_lines
from studies.random_arms import random_arm

SPEEDS = (0.05, 0.15, 0.5)
"""Mean speeds of the tip, m/s."""
KINDS = ("line", "arc", "joints")
PERIOD_S = 0.05
ELASTIC = ("joint_gain", "joint_compliance", "link_stiffness")
PLAY = "friction_hysteresis"
"""Every other arm has it: where a joint turns, its play has to be taken up."""
ROWS, NOISE_M = 300, 2e-4
"""Of the calibration."""
_DENSE = 4001
_LOOKED_AT = 5  # places between two way-points


@dataclass(frozen=True)
class Play(HiddenEffect):
    """Joints stand behind their commands by what the context says, as `lagging` computes it."""

    def joints(self, q: np.ndarray, state: State) -> np.ndarray:
        """Return the commands less that."""
        return np.asarray(q - state.behind)


def lagging(q: np.ndarray, half: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Return (M, n): how far joints stand behind commands (M, n) one after the other.

    Play of `half` (n,) to either side; before the first command they stand `behind` (n,).
    """
    made = np.empty_like(q)
    for k, move in enumerate(np.diff(q, axis=0, prepend=q[:1])):
        made[k] = behind = np.clip(behind + move, -half, half)
    return made


@dataclass(frozen=True, eq=False)
class Way:
    """A planned path.

    Attributes:
        plan: as the planner sends it. curve: (M, 3) m, what it means, densely.
    """

    plan: PlannedPath
    curve: np.ndarray


@dataclass(frozen=True, eq=False)
class StudiedArm:
    """An arm, its truth, half the play of its joints (n,), and the model of a calibration."""

    arm: Arm
    true: TrueArm
    half: np.ndarray
    model: Model

    @classmethod
    def draw(cls, declared: Arm, number: int, seed: int, names: Sequence[str]) -> StudiedArm:
        """Draw lengths and stiffness, and hidden effects whose kinds the calibration is told."""
        rng = np.random.default_rng([seed, number])
        arm = random_arm(rng, declared)
        effects = [hidden(name, arm, 1.0, rng) for name in ("joint_zero", "dh_error", *names)]
        half = sum((e.lag for e in effects if isinstance(e, FrictionHysteresis)), np.zeros(arm.n))
        kept = [e for e in effects if not isinstance(e, FrictionHysteresis)]
        true = TrueArm(arm, [Play(), *kept], steps=2)
        q, side = random_joints(arm, ROWS, rng), rng.choice([-1.0, 1.0], ROWS)
        clean = true.tip(q, TrueContext(behind=side[:, None] * half))
        seen = clean + NOISE_M * rng.standard_normal((ROWS, 3))
        rows = Session.record(q, seen, approach=side, source=f"arm {number}")
        *_, (_, geometry) = fit_stages(declared_model(arm), rows)
        terms = [t for name in names for t in effect_class(name, "study path").for_arm(arm)]
        fitted = fit_model(geometry.model.plus(*terms), rows)
        return cls(arm, true, half, with_uncertainty(fitted))


def way(arm: Arm, kind: str, speed: float, rng: np.random.Generator) -> Way:
    """Return a random path of the declared arm from rest to rest at a mean speed of the tip, m/s.

    A line ends at the tips of two random postures, an arc runs through those of three.
    """
    rigid = Model(arm)
    while True:
        margin = 0.1 * (arm.upper - arm.lower)  # the real joints end elsewhere
        ends = np.clip(random_joints(arm, 2, rng), arm.lower + margin, arm.upper - margin)
        knots = np.linspace(0.0, 1.0, _DENSE)[:, None]
        joints = ends[0] + knots * (ends[1] - ends[0])
        curve = rigid.tip(joints)
        if kind != "joints":
            middle = curve[_DENSE // 2] if kind == "arc" else 0.5 * (curve[0] + curve[-1])
            curve = through(curve[0], middle, curve[-1], knots[:, 0])
        length = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
        times = np.linspace(0.0, length / speed, max(4, round(length / speed / PERIOD_S)) + 1)
        share = times / times[-1]
        at = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        straight = ends[0] + at[:, None] * (ends[1] - ends[0])
        if kind == "joints":
            return Way(PlannedPath.of_joints(arm, times, straight), curve)
        points = np.stack([np.interp(at, knots[:, 0], axis) for axis in curve.T], axis=1)
        found = ik.solve_many(rigid, points, seed=straight, max_starts=1)
        if found.ok.all():
            return Way(PlannedPath.of_joints(arm, times, found.q), curve)


def through(a: np.ndarray, b: np.ndarray, c: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return points (M, 3) at shares (M,) of the arc from a through b to c, or of the line."""
    chord, half = c - a, b - 0.5 * (a + c)
    along = chord / np.linalg.norm(chord)
    rise = half - (half @ along) * along
    height, width = np.linalg.norm(rise), 0.5 * np.linalg.norm(chord)
    if height < 1e-6 * width:
        return a + share[:, None] * chord
    up, radius = rise / height, (width**2 + height**2) / (2.0 * height)
    opening = 2.0 * np.arctan2(height, width)  # half of the arc's angle
    angle = opening * (2.0 * share - 1.0)
    centre = 0.5 * (a + c) + (height - radius) * up
    return centre + radius * (np.sin(angle)[:, None] * along + np.cos(angle)[:, None] * up)


def follow(studied: StudiedArm, found: Way) -> dict[str, float]:
    """Follow one path before and after compensation; also what that cost."""
    arm, plan, n = studied.arm, found.plan, studied.arm.n
    assert plan.joints is not None and plan.times is not None
    came = History.unknown(n).after(plan.joints[:1], arm.mid)
    before = CubicPath(plan.times, plan.joints, smooth_slopes(plan.times, plan.joints))
    started = time.process_time()
    made: CompensatedPath = compensate_path(
        studied.model, None, plan, start=None, history=came,
        context_at=lambda arrived: Context(**arrived.fields()),
    )  # fmt: skip
    spent = time.process_time() - started
    off = [deviation(studied, path, found.curve, came.approach) for path in (before, made.timed)]
    jerk = [path.mean_square_jerk(arm.upper - arm.lower) for path in (before, made.timed)]
    return {
        "way_points": len(plan.times),
        "before_ms": float((off[0] ** 2).mean()), "after_ms": float((off[1] ** 2).mean()),
        "before_max_m": float(off[0].max()), "after_max_m": float(off[1].max()),
        "jerk_before": jerk[0], "jerk_after": jerk[1],
        "longer": made.timed.stretch, "spent_s": spent,
    }  # fmt: skip


def deviation(
    studied: StudiedArm, path: CubicPath, curve: np.ndarray, sides: np.ndarray
) -> np.ndarray:
    """Compute distances (M,), m, of the true tip from the curve; joints came from sides (n,)."""
    count = _LOOKED_AT * (len(path.times) - 1) + 1
    joints = path.at(
        np.interp(np.arange(count) / _LOOKED_AT, np.arange(len(path.times)), path.times)
    )
    behind = lagging(joints, studied.half, sides * studied.half)
    tips = studied.true.tip(joints, TrueContext(behind=behind))
    a, along = curve[:-1], np.diff(curve, axis=0)
    nearest = np.empty(len(tips))
    for k, tip in enumerate(tips):
        share = np.clip(((tip - a) * along).sum(1) / (along * along).sum(1), 0.0, 1.0)
        nearest[k] = np.linalg.norm(tip - a - share[:, None] * along, axis=1).min()
    return nearest


def one_arm(declared: Arm, number: int, seed: int, each: int) -> list[dict[str, Any]]:
    """Return `each` paths of every kind and speed on one arm."""
    names = (*ELASTIC, PLAY) if number % 2 else ELASTIC
    studied = StudiedArm.draw(declared, number, seed, names)
    known = Context(**History.unknown(studied.arm.n).fields())
    ik.warm_up(physics_of(studied.model, Method.DEFLECTION), known)
    lines: list[dict[str, Any]] = []
    for kind in KINDS:
        for speed in SPEEDS:
            for repeat in range(each):
                rng = np.random.default_rng([seed, number, KINDS.index(kind), repeat])
                done = follow(studied, way(studied.arm, kind, speed, rng))
                lines.append({"kind": kind, "speed": speed, "play": bool(number % 2), **done})
    return lines


def table(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row a kind and speed, with play and without; lengths in mm."""
    rows = []
    for play in (False, True):
        for kind in KINDS:
            for speed in SPEEDS:
                key = (kind, speed, play)
                mine = [x for x in lines if (x["kind"], x["speed"], x["play"]) == key]
                if not mine:
                    continue
                points = np.array([x["way_points"] for x in mine], float)
                rms = [
                    1e3 * float(np.sqrt(np.average([x[name] for x in mine], weights=points)))
                    for name in ("before_ms", "after_ms")
                ]
                rows.append({
                    "path": kind, "speed_mps": speed, "play": play,
                    "before_rms_mm": rms[0], "after_rms_mm": rms[1],
                    "before_max_mm": 1e3 * max(x["before_max_m"] for x in mine),
                    "after_max_mm": 1e3 * max(x["after_max_m"] for x in mine),
                    "jerk_ratio": float(np.sqrt(
                        sum(x["jerk_after"] for x in mine) / sum(x["jerk_before"] for x in mine)
                    )),
                    "longer": float(np.mean([x["longer"] for x in mine])),
                    "ms_per_waypoint": 1e3 * sum(x["spent_s"] for x in mine) / float(points.sum()),
                })  # fmt: skip
    return rows


@study_command(
    arm_option,
    arms_option(8, "Simulated arms; every other one has play."),
    whole_number("--paths", 2, "Paths of every kind and speed, an arm."),
    options.seed,
    options.written_option(
        "-o/--output",
        "JSON-lines file, one line an arm. Arms in it are not run again.",
        outputs.with_marks(b"{"),
    ),
)
def command(arm: Arm, arms: int, paths: int, seed: int, output: Path | None, show: Show) -> Figures:
    """Measure how far the true tip leaves a planned path, before and after compensation.

    Lines, arcs and straight plans of joints, at three speeds of the tip. After an interruption the
    same command continues its file.

    \b
    Example:
      longarm study path --arms 8 -o build/path.jsonl
    """
    done = read_lines(output) if output is not None else {}
    lines: list[dict[str, Any]] = []
    for number in each_arm(arms, show):
        case = {"id": f"{arm.hash[:12]} arm {number} seed {seed} paths {paths}"}
        if case["id"] not in done:
            done[case["id"]] = {"case": case, "lines": one_arm(arm, number, seed, paths)}
            if output is not None:
                append_line(output, done[case["id"]])
        lines += done[case["id"]]["lines"]
    rows = table(lines)
    title = f"Deviation of the true tip from planned paths, {arms} arms"
    return Figures({"rows": rows}, {title: rows})
