"""Benefit of choosing realisable joints together, and its sensitivity.

The truth is the model itself, with stepped servos and slides with steps of 0.1 mm.  Only in the
sensitivity rows do the servos or the arm differ from the declaration.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.realisable import KNOWN_TO, Lattice, Search
from longarm_comp.core.effects.placements import TipOffset
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.engines import tip_poses
from longarm_comp.core.ik.kernel import characteristic_length
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from studies.commands import Figures, Show, arm_option, study_command, whole_number
from studies.many import choose_arrays

SLIDE_STEP_M = 1e-4
POSE_LENGTH_M = 0.3
PRICES_MM_PER_DEG = (1.0, 0.3, 0.1, 0.03)
WRONG_STEPS = (996, 1010, 500)
WRONG_OFFSETS = (0.1, 0.25, 0.5)
MODEL_ERROR_M = 2e-4
PATH_STEP_M = 5e-3
PATH_POINTS = 60
TIMINGS = 5

_WRIST: list[dict[str, Any]] = [
    {"type": "revolute", "a_m": 0.04, "alpha_deg": -90, "d_m": 0, "limits_deg": [-40, 40]},
    {"type": "revolute", "a_m": 0.05, "alpha_deg": 90, "d_m": 0, "limits_deg": [-40, 40]},
]


@dataclass(frozen=True)
class ArmCase:
    """An arm with stepped servos, some of its joints locked."""

    name: str
    model: Model
    locked: tuple[int, ...] = ()

    def targets(self, count: int, rng: np.random.Generator, pose: bool) -> StudyTargets:
        """Return tips at random joints; the ideal joints for them are found from mid-range."""
        arm, locked = self.model.arm, list(self.locked)
        q = rng.uniform(arm.lower, arm.upper, (4 * count, arm.n))
        q[:, locked] = arm.mid[locked]
        poses = tip_poses(self.model, q)
        requested = poses if pose else poses[:, :3, 3]
        found = ik.solve_many(self.model, requested, locked=locked)
        kept = np.flatnonzero(found.ok)[:count]
        return StudyTargets(self, requested[kept], found.q[kept])


@dataclass(frozen=True)
class StudyTargets:
    """Targets of a case, positions (N, 3) or poses (N, 4, 4), and their ideal joints."""

    case: ArmCase
    requested: np.ndarray
    ideal: np.ndarray

    def search(self, **options: Any) -> Search:
        """Return the default options with some replaced."""
        pose = self.requested.ndim == 3
        length = POSE_LENGTH_M if pose else characteristic_length(self.case.model)
        return Search(length, **options)

    def choose(self, rows: slice = slice(None), **options: Any) -> SimpleNamespace:
        """Return the joints chosen for some of the targets."""
        case = self.case
        return choose_arrays(
            case.model.arm,
            Lattice.of(case.model.arm),
            lambda q: tip_poses(case.model, q),
            self.requested[rows],
            self.ideal[rows],
            self.search(**options),
            locked=case.locked,
        )

    def seconds(self) -> float:
        """Time a target on the processor: median over targets, each the best of several runs."""
        single = np.empty((len(self.ideal), TIMINGS))
        for i, run in np.ndindex(*single.shape):
            began = time.process_time()
            self.choose(slice(i, i + 1))
            single[i, run] = time.process_time() - began
        return float(np.median(single.min(axis=1)))


def cases(base: Arm, steps: int) -> list[ArmCase]:
    """Return variants of an arm with servos of ``steps`` per turn: slides locked, a wrist added."""
    whole = _with_steps(base, steps)
    slides: list[int] = np.flatnonzero(whole.slides).tolist()
    model = declared_model(whole).commandable
    drawn = [
        ArmCase(f"{whole.n - len(locked)} joints", model, tuple(locked))
        for locked in (slides, slides[-1:], [])
    ]
    wrist = declared_model(_with_steps(base, steps, wrist=True)).commandable
    return [*drawn, ArmCase(f"{wrist.arm.n} joints", wrist)]


def _with_steps(base: Arm, steps: int, *, wrist: bool = False) -> Arm:
    data = base.model_dump(mode="json", exclude_defaults=True)
    if wrist:
        rows = len(data["joints"])
        for k, joint in enumerate(copy.deepcopy(_WRIST), 1):
            data["joints"].append(joint | {"id": rows + k})
        data["tip"]["frame"] = rows + len(_WRIST)
    for joint in data["joints"]:
        if joint["type"] == "revolute" and "mimic" not in joint:
            joint["step_deg"] = 360 / steps
        elif joint["type"] == "prismatic" and "mimic" not in joint:
            joint["step_m"] = SLIDE_STEP_M
    return Arm.parse(data, "study")


def arms_table(base: Arm, count: int, steps: int, seed: int) -> list[dict[str, object]]:
    """Tabulate arms with few and many joints, positions and poses."""
    rows: list[dict[str, object]] = []
    for case in cases(base, steps):
        ik.warm_up(case.model)
        for pose in (False, True):
            freedom = case.model.arm.n - len(case.locked)
            if pose and freedom < 6:
                continue  # no two sets of joints for a pose
            t = case.targets(count, np.random.default_rng(seed), pose)
            got = t.choose()
            error, rounded = got.error, got.rounded_error
            rows.append(
                {
                    "arm": case.name,
                    "target": "pose" if pose else "position",
                    "targets": len(t.ideal),
                    "rounded_mm": 1e3 * rounded[:, 0].mean(),
                    "mean_mm": 1e3 * error[:, 0].mean(),
                    "p95_mm": 1e3 * np.percentile(error[:, 0], 95),
                    "rounded_mrad": 1e3 * rounded[:, 1].mean() if pose else None,
                    "mean_mrad": 1e3 * error[:, 1].mean() if pose else None,
                    "moved_deg": _largest_offset_deg(case, got, got.joints),
                    "nodes": float(got.nodes.mean()),
                    "cpu_us": 1e6 * t.seconds(),
                }
            )
    return rows


def price_table(base: Arm, count: int, steps: int, seed: int) -> list[dict[str, object]]:
    """Effect of the price of movement: errors of single targets, and moves along a line."""
    case = _whole(base, steps)
    t = case.targets(count, np.random.default_rng(seed), False)
    line = _line(case, seed)
    rows: list[dict[str, object]] = []

    def add(name: object, error: np.ndarray, at: np.ndarray, path: np.ndarray) -> None:
        steps = np.diff(path, axis=0)[:, ~case.model.arm.slides]  # between neighbours of the path
        rows.append(
            {
                "price_mm_per_deg": name,
                "mean_mm": 1e3 * error[:, 0].mean(),
                "moved_deg": _largest_offset_deg(case, single, at),
                "path_move_deg": float(np.degrees(np.abs(steps).max())),
            }
        )

    for price in PRICES_MM_PER_DEG:
        price_m = float(np.degrees(1e-3 * price))
        single, along = t.choose(price_m=price_m), line.choose(price_m=price_m)
        if not rows:
            add("ideal joints", single.ideal_error, single.ideal, along.ideal)
            add("rounding", single.rounded_error, single.rounded, along.rounded)
        add(price, single.error, single.joints, along.joints)
    return rows


def sensitivity_table(base: Arm, count: int, steps: int, seed: int) -> list[dict[str, object]]:
    """True error of rounding and of the choice if servos or arm differ from the declaration."""
    case = _whole(base, steps)
    t = case.targets(count, np.random.default_rng(seed), False)
    got = t.choose()
    arm, rng = case.model.arm, np.random.default_rng(seed)
    right, some = np.zeros(arm.n), (len(t.ideal), arm.n)
    truth = [("as declared", arm.steps, right, case.model)]
    for true in WRONG_STEPS:
        wrong = arm.steps.copy()
        wrong[~arm.slides] *= steps / true
        truth.append((f"{true} steps a turn", wrong, right, case.model))
    for share in WRONG_OFFSETS:
        offset = rng.uniform(-share, share, some) * arm.steps
        truth.append((f"offset of up to {share:g} of a step", arm.steps, offset, case.model))
    offset = rng.normal(0.0, KNOWN_TO, some) * arm.steps
    truth.append((f"offset of sd {KNOWN_TO:g} of a step", arm.steps, offset, case.model))
    aside = case.model.plus(TipOffset(x=MODEL_ERROR_M))
    truth.append((f"tip {1e3 * MODEL_ERROR_M:g} mm aside", arm.steps, right, aside))
    rows: list[dict[str, object]] = []
    for name, step, offset, model in truth:
        low = np.ceil((arm.lower - offset) / step - 1e-9)
        high = np.floor((arm.upper - offset) / step + 1e-9)
        errors = []
        for sent in (got.ideal, got.joints):  # a servo stands at the nearest of its own steps
            stood = offset + step * np.clip(np.rint((sent - offset) / step), low, high)
            errors.append(1e3 * np.linalg.norm(model.tip(stood) - t.requested, axis=1).mean())
        rows.append({"truth": name, "rounded_mm": errors[0], "mean_mm": errors[1]})
    return rows


def _whole(base: Arm, steps: int) -> ArmCase:
    case = cases(base, steps)[2]
    ik.warm_up(case.model)
    return case


def _line(case: ArmCase, seed: int) -> StudyTargets:
    """Lay a straight line between two tips, a target every `PATH_STEP_M`, each from the last."""
    arm, rng = case.model.arm, np.random.default_rng(seed)
    while True:
        q = rng.uniform(arm.lower, arm.upper, (2, arm.n))
        ends = case.model.tip(q)
        number = int(np.linalg.norm(ends[1] - ends[0]) / PATH_STEP_M)
        points = ends[0] + np.linspace(0, 1, number + 1)[:, None] * (ends[1] - ends[0])
        joints, found = [q[0]], True
        for point in points:
            solved = ik.solve(case.model, point, seed=joints[-1], max_starts=1)
            joints.append(solved.q)
            found = found and solved.ok
        if found and number >= PATH_POINTS:
            return StudyTargets(case, points, np.array(joints[1:]))


def _largest_offset_deg(case: ArmCase, got: SimpleNamespace, q: np.ndarray) -> float:
    """Return the largest move (deg) of a revolute joint from its ideal, mean over targets."""
    return float(np.degrees(np.abs(q - got.ideal)[:, ~case.model.arm.slides].max(axis=1).mean()))


@study_command(
    arm_option,
    whole_number("--targets", 60, "Targets per row."),
    whole_number(
        "--steps", 1000, "Servo steps per turn of a revolute joint; slides have 0.1 mm.", 2
    ),
    options.seed,
)
def command(arm: Arm, targets: int, steps: int, seed: int, show: Show) -> Figures:
    """Compare the choice among the servos' steps with rounding, and its sensitivity.

    The truth is the declared model with sag. No measurement is used.

    \b
    Example:
      longarm study realisable --targets 60 --json
    """
    tables = {
        "arms": ("Positions and poses (0.3 m/rad)", arms_table),
        "price": ("Price of movement; path: a line of 5 mm steps", price_table),
        "sensitivity": ("Servos or arm not as declared", sensitivity_table),
    }
    rows: dict[str, list[dict[str, object]]] = {}
    for k, (name, (title, table)) in enumerate(tables.items()):
        show(title, k / len(tables))
        rows[name] = table(arm, targets, steps, seed)
    return Figures(
        {"targets": targets, "steps_per_turn": steps, "seed": seed, **rows},
        {title: rows[name] for name, (title, _) in tables.items()},
    )
