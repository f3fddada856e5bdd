"""A palletiser whose joints were moved one at a time, and its rows as they were measured."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.data.session import Session
from longarm_comp.core.model.model import Model

NOISE = 3e-5
MARKERS = ((0.1, 0.0, -0.2), (-0.1, 0.1, -0.2), (-0.1, -0.1, -0.2))
ROWS: tuple[dict[str, Any], ...] = (
    {"name": "J1", "d_m": 0.67, "limits_deg": [-185, 185]},
    {"name": "J2", "a_m": 0.312, "alpha_deg": -90, "theta_offset_deg": -90,
     "limits_deg": [-60, 76]},
    {"name": "elbow", "a_m": 1.075, "alpha_deg": 180, "limits_deg": [-132, 230]},
    {"name": "J4", "a_m": 0.225, "alpha_deg": -90, "d_m": -1.28, "limits_deg": [-360, 360]},
    {"name": "J5", "alpha_deg": 90, "limits_deg": [-125, 125]},
    {"name": "J6", "alpha_deg": -90, "d_m": -0.215, "limits_deg": [-360, 360]},
)  # fmt: skip


def machine(rows: Sequence[Mapping[str, Any]]) -> Arm:
    last = len(rows)
    joints = [{"id": k, "type": "revolute", **row} for k, row in enumerate(rows, 1)]
    markers = {f"M{k}": {"frame": last, "position_m": at} for k, at in enumerate(MARKERS, 1)}
    tip = {"frame": last, "position_m": [0.0, 0.0, 0.1]}
    declared = {"convention": "mdh_craig", "tip": tip, "joints": joints, "markers": markers}
    return Arm.parse({"name": "palletiser", **declared}, "palletiser")


PALLETISER = machine(ROWS)
FOREARM = {"name": "J3", "limits_deg": [-132, 230], "moves": False}
FOLLOWS = {"mimic": [{"joint": "J2", "multiplier": 1}, {"joint": "J3", "multiplier": 1}]}
ELBOW = {key: value for key, value in ROWS[2].items() if key != "limits_deg"} | FOLLOWS
COUPLED = machine((FOREARM, *ROWS[:2], ELBOW, *ROWS[3:]))
"""The same machine by its controller: J3 is the angle of the forearm to the horizon."""
OF_CONTROLLER = [2, 0, 1, 3, 4, 5]
WAYS = (
    [(v, 0, 0, 0, 0, 0) for v in range(-9, 52, 12)]
    + [(47, v, -v, 0, 0, 0) for v in range(-30, 51, 16)]
    + [(47, 0, v, 0, 0, 0) for v in range(-55, 21, 15)]
    + [(47, 0, 0, v, 0, 0) for v in range(-360, 361, 144)]
    + [(47, 0, 0, 0, v, 0) for v in range(-75, 56, 26)]
    + [(47, 0, 0, 0, 0, v) for v in range(-360, 361, 144)]
)
"""Poses (deg) of a machine whose joints are moved one at a time; its forearm keeps its angle to the
horizon when joint 2 moves."""


def truth(rng: np.random.Generator) -> Model:
    """An arm as it was made: errors of its drawing's tolerances."""
    drawn = Model(PALLETISER).plus(*(t for t in geometry_terms(PALLETISER, rows(np.zeros((4, 6))))))
    sizes = [0.0 if s.parameter.unknown else 0.3 * s.parameter.width for s in drawn.slots]
    return drawn.with_values(np.array(sizes) * rng.standard_normal(len(sizes)))


def rows(commanded: np.ndarray, made: Model | None = None, seed: int = 0) -> Session:
    """Three markers at every pose: of joints (N, 6), rad, as arm.yaml declares them."""
    q = np.repeat(commanded, 3, axis=0)
    labels = {"marker": np.array([f"M{k}" for k in (1, 2, 3)] * len(commanded))}
    index = np.repeat(np.arange(len(commanded)), 3)
    session = Session.record(q, np.zeros((len(q), 3)), index=index, labels=labels)
    if made is None:
        return session
    rng = np.random.default_rng(seed)
    xyz = made.measured(q, session.context()) + NOISE * rng.standard_normal((len(q), 3))
    return dataclasses.replace(session, xyz=xyz)


def one_at_a_time(made: Model) -> tuple[Session, Session]:
    """Rows of the machine by the angles of its joints, and by those of its controller."""
    told = np.radians(np.array(WAYS, float))
    seen = rows(joints_of(told), made)
    return seen, dataclasses.replace(seen, q=np.repeat(told, 3, axis=0))


def joints_of(told: np.ndarray) -> np.ndarray:
    """Return the angles of the joints, (N, 6), by those of the controller."""
    joints = told.copy()
    joints[:, 2] += told[:, 1]
    return joints


def soft_rows(
    made: Model, told: np.ndarray, softness: float, seed: int, coupled: bool = False
) -> Session:
    """Rows of a machine whose weight is all at its wrist, and whose joint 2 yields under it.

    Args:
        told: angles of the controller, (N, 6), rad.
        softness: rad by which the joint yields per metre of the wrist's level distance.
        coupled: whether the rows are of `COUPLED`.
    """
    joints = joints_of(told)
    bent = joints.copy()
    bent[:, 1] += softness * (1.075 * np.sin(told[:, 1]) + 1.28 * np.cos(told[:, 2]))
    q = told[:, OF_CONTROLLER] if coupled else joints
    return dataclasses.replace(rows(bent, made, seed), q=np.repeat(q, 3, axis=0))
