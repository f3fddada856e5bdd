"""The rows that a calibration needs, by what a row measures: pose, position, distance, touch."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import PRINTED, Anchor
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.math.points import kabsch
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.geometry import DhError, JointZero
from studies.commands import Figures, Show, arm_option, arms_option, each_arm, study_command

ROWS = (15, 20, 30, 45, 70, 110, 170, 260)
"""Rows that are fitted."""
SIGMA_M, SIGMA_RAD, SIGMA_TOUCH_M = 3e-4, 1e-3, 1e-4
"""Noise of a coordinate or a distance, an orientation about each axis, a ball in a cone."""
ZERO_RAD, ROW_M, ROW_RAD = 4e-3, 1e-3, 4e-3
"""Standard deviations of the hidden joint zeros and row errors."""
FRESH = 200
ANCHORS = {"left": (0.3, -1.5, 0.1), "right": (1.8, -0.9, 0.3), "top": (0.9, 0.4, 1.8)}
"""Draw-wires: where they are anchored, m; row by row one of them is read."""
PLACES, GAP_M = 3, 0.05
"""Places of a plate, and the distance of its two sockets."""

Reading = Callable[["_Rows"], Mapping[str, Any]]


@dataclass(frozen=True)
class _Rows:
    q: np.ndarray
    pose: np.ndarray
    names: np.ndarray
    rng: np.random.Generator

    def position(self) -> np.ndarray:
        noise = SIGMA_M * self.rng.standard_normal((len(self.q), 3))
        return np.asarray(self.pose[:, :3, 3] + noise)

    def orientation(self) -> np.ndarray:
        noise = Rotation.from_rotvec(SIGMA_RAD * self.rng.standard_normal((len(self.q), 3)))
        return np.asarray((noise * Rotation.from_matrix(self.pose[:, :3, :3])).as_quat())


def _pose(rows: _Rows) -> Mapping[str, Any]:
    return {"xyz": rows.position(), "readings": {"orientation": rows.orientation()}}


def _position(rows: _Rows) -> Mapping[str, Any]:
    return {"xyz": rows.position()}


def _distance(rows: _Rows) -> Mapping[str, Any]:
    names = np.array(list(ANCHORS))[np.arange(len(rows.q)) % len(ANCHORS)]
    away = rows.pose[:, :3, 3] - np.array([ANCHORS[name] for name in names])
    length = np.linalg.norm(away, axis=1) + SIGMA_M * rows.rng.standard_normal(len(names))
    return {
        "xyz": np.full((len(names), 3), np.nan),
        "readings": {"distance": length[:, None]},
        "labels": {"anchor": names},
    }


def _touch(rows: _Rows) -> Mapping[str, Any]:
    places = dict.fromkeys(name.partition("_")[0] for name in rows.names)
    known = [(f"{place}_0", f"{place}_1", GAP_M, PRINTED) for place in places]
    return {
        "xyz": np.full((len(rows.q), 3), np.nan),
        "labels": {"touch": rows.names},
        "touch_distances": known,
    }


KINDS: Mapping[str, Reading] = {
    "pose": _pose, "position": _position, "distance": _distance, "touch": _touch,
}  # fmt: skip


def errors_by_rows(arm: Arm, seed: int, counts: Sequence[int] = ROWS) -> dict[str, np.ndarray]:
    """Mean error (m) of the true tip at fresh poses, by kind, one number per count of rows.

    The arm's joint zeros and rows are off by hidden amounts; placement and tip are unknown. All
    kinds measure the same poses, but touches: these are at two sockets of a plate at three places,
    and as they do not tell where the base stands, errors are those of the best placement.
    """
    rng = np.random.default_rng(seed)
    rows = len(arm.joints)
    scale = np.array([ROW_RAD, ROW_M, ROW_RAD, ROW_M])[:, None]
    hidden = (
        JointZero(ZERO_RAD * rng.standard_normal(arm.n) * ~arm.slides),
        DhError(0.5 * scale * rng.standard_normal((4, rows))),
    )
    true = TrueArm(arm, hidden)
    largest = max(counts)
    drawn = arm.lower + (arm.upper - arm.lower) * rng.random((largest + FRESH, arm.n))
    pose = true.pose(drawn)
    fresh_q, fresh = drawn[largest:], pose[largest:, :3, 3]
    anywhere = drawn[:largest], pose[:largest], np.full(largest, "")
    touched = _touching(arm, true, largest, rng)
    sited = arm.model_copy(update={"anchors": {k: Anchor(xyz_m=v) for k, v in ANCHORS.items()}})
    made: dict[str, np.ndarray] = {}
    for kind, read in KINDS.items():
        left = []
        for count in counts:
            rows_of = touched if kind == "touch" else anywhere
            q_, pose_, names = (part[:count] for part in rows_of)
            taken = _Rows(q_, pose_, names, np.random.default_rng([seed, count]))
            session = Session.record(taken.q, source=kind, **read(taken))
            *_, (_, fitted) = fit_stages(declared_model(sited), session)
            said = fitted.model.tip(fresh_q)
            if kind == "touch":
                turn, shift = kabsch(said, fresh, np.ones(len(said)))
                said = said @ turn.T + shift
            left.append(np.linalg.norm(said - fresh, axis=1).mean())
        made[kind] = np.array(left)
    return made


def _touching(
    arm: Arm, true: TrueArm, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return joints, true poses and names of rows that touch every socket in turn."""
    middle = arm.lower + (arm.upper - arm.lower) * (0.25 + 0.5 * rng.random((PLACES, arm.n)))
    first = true.pose(middle)[:, :3, 3]
    way = rng.standard_normal((PLACES, 3))
    other = first + GAP_M * way / np.linalg.norm(way, axis=1, keepdims=True)
    sockets = np.stack([first, other], axis=1).reshape(-1, 3)
    number = np.arange(count) % len(sockets)
    names = np.array([f"{k // 2}_{k % 2}" for k in number])
    q = joints_at(arm, true, sockets[number] + SIGMA_TOUCH_M * rng.standard_normal((count, 3)), rng)
    return q, true.pose(q), names


def joints_at(arm: Arm, true: TrueArm, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (N, n) joints within the limits at which the true tip is at points (N, 3), m."""
    drawn, room = Model(arm), arm.upper - arm.lower

    def towards(q: np.ndarray, away: np.ndarray) -> np.ndarray:
        steps = 1e-5 * np.eye(arm.n)
        columns = np.stack([(drawn.tip(q + e) - drawn.tip(q - e)) / 2e-5 for e in steps], axis=2)
        return q + np.clip(
            (np.linalg.pinv(columns, rcond=1e-2) @ away[..., None])[..., 0], -0.3, 0.3
        )

    found = np.full((len(points), arm.n), np.nan)
    while np.isnan(found).any():
        left = np.flatnonzero(np.isnan(found[:, 0]))
        q = arm.lower + room * (0.1 + 0.8 * rng.random((len(left), arm.n)))
        for _ in range(30):
            q = towards(q, points[left] - drawn.tip(q))
        for _ in range(5):
            away = points[left] - true.pose(q)[:, :3, 3]
            q = towards(q, away)
        there = np.linalg.norm(away, axis=1) < 1e-6
        inside = ((q > arm.lower) & (q < arm.upper)).all(axis=1)
        found[left[there & inside]] = q[there & inside]
    return found


def table(found: Sequence[Mapping[str, np.ndarray]], counts: Sequence[int]) -> list[dict[str, Any]]:
    """Return rows of the table: median error over the arms in mm, by count and kind."""
    middle = {kind: np.median([one[kind] for one in found], axis=0) for kind in KINDS}
    return [
        {"rows": int(count), **{f"{k}_mm": round(1e3 * float(middle[k][i]), 3) for k in KINDS}}
        for i, count in enumerate(counts)
    ]


def rows_needed(
    found: Sequence[Mapping[str, np.ndarray]], counts: Sequence[int], limits_m: Sequence[float]
) -> list[dict[str, Any]]:
    """Count rows that reach an error, by kind: median over the arms; None where most never do."""
    made = []
    for limit in limits_m:
        row: dict[str, Any] = {"error_mm": 1e3 * limit}
        for kind in KINDS:
            first = [_first(one[kind], counts, limit) for one in found]
            middle = float(np.median(first))
            row[kind] = round(middle) if np.isfinite(middle) else None
        made.append(row)
    return made


def _first(errors: np.ndarray, counts: Sequence[int], limit: float) -> float:
    """Return rows from which on the error stays below a limit, between the counts in logarithms."""
    above = np.flatnonzero(errors > limit)
    if not len(above):
        return float(counts[0])
    k = int(above[-1])
    if k + 1 == len(counts):
        return float("inf")
    high, low = np.log(errors[k]), np.log(errors[k + 1])
    share = (high - np.log(limit)) / (high - low)
    ends = np.log([counts[k], counts[k + 1]])
    return float(np.exp(ends[0] + share * (ends[1] - ends[0])))


@study_command(arm_option, arms_option(5), options.seed)
def command(arm: Arm, arms: int, seed: int, show: Show) -> Figures:
    """Count the rows that a calibration needs, of poses, positions, distances, or touches.

    Errors are of the true tip at poses that were not measured.

    \b
    Example:
      longarm study measurements --arms 5
    """
    found = [errors_by_rows(arm, seed + k) for k in each_arm(arms, show)]
    rows, least = table(found, ROWS), rows_needed(found, ROWS, (1e-3, 5e-4, 2.5e-4))
    return Figures(
        {"arms": arms, "seed": seed, "errors": rows, "needed": least},
        {f"Error of the true tip, median of {arms} arms": rows, "Rows needed": least},
    )
