"""A cobot whose joints turn far, and a plan that turns one on through pi."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.path import CompensatedPath, compensate_path
from longarm_comp.core.compensation.planned_path import PlannedPath
from longarm_comp.core.model.model import Model

TIMES = np.linspace(0.0, 2.0, 21)
ALONG = 3 * (TIMES / 2) ** 2 - 2 * (TIMES / 2) ** 3


def declared(
    half_deg: float, rows: Mapping[int, Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """Six turning joints as a cobot has them, each by so much to either side."""
    shape: tuple[dict[str, Any], ...] = (
        {"d_m": 0.0892}, {"alpha_deg": 90}, {"a_m": -0.425}, {"a_m": -0.392, "d_m": 0.1093},
        {"alpha_deg": 90, "d_m": 0.09475}, {"alpha_deg": -90, "d_m": 0.0825},
    )  # fmt: skip
    turning = {"type": "revolute", "limits_deg": [-half_deg, half_deg]}
    joints = [
        {"id": k, "name": f"joint{k}", **turning, **keys, **(rows or {}).get(k, {})}
        for k, keys in enumerate(shape, 1)
    ]
    return {"name": "cobot", "convention": "mdh_craig", "tip": {"frame": 6}, "joints": joints}


def arm(half_deg: float, rows: Mapping[int, Mapping[str, Any]] | None = None) -> Arm:
    return Arm.parse(declared(half_deg, rows), "cobot")


def wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def through_pi() -> tuple[np.ndarray, np.ndarray]:
    """(21, 6) each: joint 1 turns from 3.0 rad on through pi, as it goes and as a planner says."""
    goes = np.tile([3.0, -1.3, 1.4, -1.7, -1.5, 0.2], (len(TIMES), 1))
    goes[:, 0] += (2 * np.pi - 6.0) * ALONG
    said = goes.copy()
    said[:, 0] = wrapped(goes[:, 0])
    assert np.ptp(said[:, 0]) > 6.0
    return goes, said


def follow(model: Model, joints: np.ndarray, start: np.ndarray, **more: Any) -> CompensatedPath:
    return compensate_path(
        model, None, PlannedPath.of_joints(model.arm, TIMES, joints), start=start,
        history=History.unknown(model.arm.n), context_at=lambda arrived: Context(), **more,
    )  # fmt: skip
