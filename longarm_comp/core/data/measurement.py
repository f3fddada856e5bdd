"""Scalar equations of a session: its measurements less the predictions of a model.

Every row has the session's d channels.  In channels that a row did not measure, residual and
columns are 0, so these equations have no influence in a least-squares problem.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.data.kinds import KINDS, Equations
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.touched import with_touched
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.model.model import Model, Slot
from longarm_comp.core.model.tip_motion import TipMotion


def compute_posture(model: Model, session: Session) -> Posture:
    """Compute the arm's posture at the rows of a session."""
    return model.posture([session.q[:, j] for j in range(session.n)], session.context())


def make_equations(
    model: Model,
    session: Session,
    slots: Sequence[Slot] | None = None,
    *,
    at: Posture | None = None,
) -> Equations:
    """Make the equations of all rows and channels of a session.

    Args:
        slots: the p parameters of the columns; by default all of the model's.
        at: posture of the arm at the rows, if it was computed already.

    Returns:
        Residuals (N, d) in m and rad, columns (N, d, p) and pulls (N, d, 3).
    """
    slots = model.slots if slots is None else slots
    at = compute_posture(model, session) if at is None else at
    model = with_touched(model, session, at)
    return _stack(model.motion(at, slots, session.turns), session)


def compute_shifts(
    model: Model, session: Session, at: Posture, terms: Sequence[Effect | Bias]
) -> np.ndarray:
    """Compute the change (N, d, k) of the prediction by each of k terms outside the model.

    Args:
        at: posture of the arm at the N rows.
        terms: the k terms, with the values that they shall have.
    """
    model = with_touched(model, session, at)
    return _stack(model.motion_with(at, terms, session.turns), session).columns


def compute_unit_lengths(model: Model, session: Session) -> np.ndarray:
    """Compute the length at the tip (m) that corresponds to a unit of each channel, (d,).

    It is 1 for channels in m and 0 for orientations.  For a ray it is the median distance of the
    tip from the camera, and for an encoder the median displacement of the tip per unit of its
    joint.
    """
    units = np.array(session.units)
    made = (units == "m").astype(float)
    if session.read_joints:
        zeros = [JointZero(model.arm.commanded[k], offset=1.0) for k in session.read_joints]
        moved = model.motion_with(compute_posture(model, session), zeros).point()[1]
        levers = np.median(np.linalg.norm(moved, axis=1), axis=0)
        made[[session.channels.index(f"read_q{k + 1}") for k in session.read_joints]] = levers
    if "ray" not in session.readings:
        return made
    pull = np.linalg.norm(make_equations(model, session, ()).pull, axis=2)
    for k in np.flatnonzero((units == "rad") & (made == 0.0)):
        some = pull[:, k][pull[:, k] > 0]
        made[k] = 1.0 / float(np.median(some)) if len(some) else 0.0
    return made


def compute_tip_errors(model: Model, session: Session, near: Posture | None = None) -> np.ndarray:
    """Compute measured - predicted, (M, 3) m, of the M rows that measure the tip's position.

    In rows without a whole position it is the smallest displacement of the tip that explains the
    measurement.

    Args:
        near: a similar model's posture at the M rows, which saves time.
    """
    placed = session.take(session.placed)
    if not len(placed):
        return np.zeros((0, 3))
    at = compute_posture(model, placed) if near is None else model.posture_near(near)
    return tip_errors_at(model, placed, at)


def tip_errors_at(model: Model, placed: Session, at: Posture) -> np.ndarray:
    """Compute `compute_tip_errors` of rows that all measure the position, from their posture."""
    positions = np.asarray(placed.xyz - model.measured_at(at))
    if placed.plain:
        return positions
    found = make_equations(model, placed, (), at=at)
    moved = np.linalg.pinv(found.pull, rcond=1e-6) @ found.residual[..., None]
    return np.where(placed.has_position[:, None], positions, moved[..., 0])


def compute_touch_errors(model: Model, session: Session) -> np.ndarray:
    """Compute the distances (M,), m, between predicted tip and touched point, in the M touch rows.

    The touched points are placed by these rows alone.
    """
    rows = session.take(session.reading(KINDS["touch"])[:, 0] == 0.0)
    if not len(rows):
        return np.zeros(0)
    nothing: dict[str, Any] = {"sigma": None, "readings": {}, "sigmas": {}, "blocks": ()}
    labels = {k: v for k, v in rows.labels.items() if k not in ("plane", "sensor")}
    blank = np.full(rows.xyz.shape, np.nan)
    alone = dataclasses.replace(rows, xyz=blank, labels=labels, touch_distances=(), **nothing)
    return np.asarray(np.linalg.norm(compute_tip_errors(model.lasting(), alone), axis=1))


def compute_turn_errors(model: Model, session: Session) -> np.ndarray:
    """Compute the rotation vectors (M, 3), rad, from predicted to M measured orientations."""
    turned = session.take(session.has_orientation)
    if not len(turned):
        return np.zeros((0, 3))
    motion = model.motion(compute_posture(model, turned), (), turns=True)
    kind = KINDS["orientation"]
    return kind.equations(motion, turned.readings[kind.name], turned.labels).residual


def _stack(motion: TipMotion, session: Session) -> Equations:
    if session.plain:
        point, columns = motion.point()
        return Equations(session.xyz - point, columns, np.zeros((0, 3, 3)))
    labels, kept = session.labels, session.measured
    made = {k.name: k.equations(motion, session.reading(k), labels) for k in session.kinds}
    parts = [made[block.kind] for block in session.blocks]

    def of(name: str) -> np.ndarray:
        whole = np.concatenate([getattr(part, name) for part in parts], axis=1)
        return np.where(kept if whole.ndim == 2 else kept[..., None], whole, 0.0)

    return Equations(of("residual"), of("columns"), of("pull"))
