"""How many rows a calibration needs, by what a row measures: pose, position, distance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import Anchor
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.calibrate import stages
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.geometry import DhError, JointZero

ROWS = (15, 20, 30, 45, 70, 110, 170, 260)
"""Rows that are fitted."""
SIGMA_M, SIGMA_RAD = 3e-4, 1e-3
"""Noise of a coordinate or a distance, and of an orientation about each axis."""
ZERO_RAD, ROW_M, ROW_RAD = 4e-3, 1e-3, 4e-3
"""Standard deviations of the hidden joint zeros and row errors."""
FRESH = 200
ANCHORS = {"left": (0.3, -1.5, 0.1), "right": (1.8, -0.9, 0.3), "top": (0.9, 0.4, 1.8)}
"""Draw-wires: where they are anchored, m; row by row one of them is read."""

Reading = Callable[["_Rows"], Mapping[str, Any]]


@dataclass(frozen=True)
class _Rows:
    q: np.ndarray
    pose: np.ndarray
    rng: np.random.Generator

    def position(self) -> np.ndarray:
        noise = SIGMA_M * self.rng.standard_normal((len(self.q), 3))
        return np.asarray(self.pose[:, :3, 3] + noise)

    def turned(self) -> np.ndarray:
        noise = Rotation.from_rotvec(SIGMA_RAD * self.rng.standard_normal((len(self.q), 3)))
        return np.asarray((noise * Rotation.from_matrix(self.pose[:, :3, :3])).as_quat())


def _pose(rows: _Rows) -> Mapping[str, Any]:
    return {"xyz": rows.position(), "readings": {"orientation": rows.turned()}}


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


KINDS: Mapping[str, Reading] = {"pose": _pose, "position": _position, "distance": _distance}


def errors_by_rows(arm: Arm, seed: int, counts: Sequence[int] = ROWS) -> dict[str, np.ndarray]:
    """Mean error (m) of the true tip at fresh poses, by kind, one number per count of rows.

    The arm's joint zeros and rows are off by hidden amounts; placement and tip are unknown. All
    kinds measure the same poses.
    """
    rng = np.random.default_rng(seed)
    rows = len(arm.joints)
    scale = np.array([ROW_RAD, ROW_M, ROW_RAD, ROW_M])[:, None]
    hidden = (
        JointZero(ZERO_RAD * rng.standard_normal(arm.n) * _turning(arm)),
        DhError(0.5 * scale * rng.standard_normal((4, rows))),
    )
    true = TrueArm(arm, hidden)
    largest = max(counts)
    q = arm.lower + (arm.upper - arm.lower) * rng.random((largest + FRESH, arm.n))
    pose = true.pose(q)
    fresh_q, fresh = q[largest:], pose[largest:, :3, 3]
    sited = arm.model_copy(update={"anchors": {k: Anchor(xyz_m=v) for k, v in ANCHORS.items()}})
    made: dict[str, np.ndarray] = {}
    for kind, read in KINDS.items():
        left = []
        for count in counts:
            taken = _Rows(q[:count], pose[:count], np.random.default_rng([seed, count]))
            session = Session.record(taken.q, source=kind, **read(taken))
            *_, (_, fitted) = stages(declared_model(sited), session)
            left.append(np.linalg.norm(fitted.model.tip(fresh_q) - fresh, axis=1).mean())
        made[kind] = np.array(left)
    return made


def _turning(arm: Arm) -> np.ndarray:
    return np.array([arm.joints[row - 1].type == "revolute" for row in arm.commanded], float)


def study(
    arm: Arm, seeds: Sequence[int], counts: Sequence[int] = ROWS
) -> Iterator[dict[str, np.ndarray]]:
    """`errors_by_rows` of one arm after the other."""
    for seed in seeds:
        yield errors_by_rows(arm, seed, counts)


def table(found: Sequence[Mapping[str, np.ndarray]], counts: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of the table: median error over the arms in mm, by count and kind."""
    middle = {kind: np.median([one[kind] for one in found], axis=0) for kind in KINDS}
    return [
        {"rows": int(count), **{f"{k}_mm": round(1e3 * float(middle[k][i]), 3) for k in KINDS}}
        for i, count in enumerate(counts)
    ]


def needed(
    found: Sequence[Mapping[str, np.ndarray]], counts: Sequence[int], limits_m: Sequence[float]
) -> list[dict[str, Any]]:
    """Rows that reach an error, by kind: the median over the arms; None where most never do."""
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
    """Rows from which on the error stays below a limit, between the counts in logarithms."""
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
