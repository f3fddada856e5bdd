"""Errors as a command would have them: what the tip would miss a target by, with this model.

A measurement holds more than a command can use, and `compute_tip_errors` uses all of it: causes on
the measuring side, moves before the last that only a side was recorded of, circumstances that no
command is told (docs/report.md, "As seen and as commanded").
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from longarm_comp.core.arm.context import CLOCK, NEVER_TOLD, ORDER
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.data.measurement import compute_posture, compute_tip_errors, tip_errors_at
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.model.model import Model

MEASURING_SIDE = "(measuring side)"


def commanded_errors(model: Model, session: Session, near: Posture | None = None) -> np.ndarray:
    """Compute measured - predicted, (M, 3) m, with what a command knows; by `compute_tip_errors`.

    What the measuring side moves the fitted rows by alike is a choice of frame (`frame_shift`), in
    which targets are taken too (`core/compensation/target_frame.py`).
    `near` is a similar model's posture at these rows, as there.
    """
    told = as_commanded(model)
    missed = compute_tip_errors(told, own_way(session), near)
    return missed if told.biases == model.biases else missed - model.frame_shift


def with_frame_shift(model: Model, session: Session) -> Model:
    """Return the model with the mean shift of a session's rows by its biases, as `frame_shift`."""
    moved = moved_by_measuring(model, session)
    x, y, z = moved.mean(axis=0).tolist() if len(moved) else (0.0, 0.0, 0.0)
    return dataclasses.replace(model, frame_shift=(x, y, z))


def in_frame_of_start(model: Model, session: Session) -> Model:
    """Return the model with targets in the frame of the session's first row, if it drifts.

    The tip does not move with what measures it, and points are marked before a session.
    """
    if not any(CLOCK in b.inputs for b in model.biases):
        return model
    first = np.full(len(session), session.columns[CLOCK].min())
    columns = {**session.columns, CLOCK: first}
    return with_frame_shift(model, dataclasses.replace(session, columns=columns))


def moved_by_measuring(model: Model, session: Session) -> np.ndarray:
    """Compute how far the measuring side moves the M rows that say where the tip is, (M, 3) m; no
    rows where the model has nothing there."""
    told = as_commanded(model)
    return _difference(told, dataclasses.replace(told, biases=model.biases), session)


def moved_with_time(model: Model, session: Session, variance: float) -> np.ndarray:
    """Return (M, 3) m, how far a frame may have moved instead of what moves with time in the model.

    It is relative to the last row: commands take the arm as the session left it.  No measurement
    tells a base that moved, or a marker, from a camera that did.  An effect of a joint counts by
    the likelihood, relative to its own, that the frame moved so.

    Args:
        variance: of a coordinate's noise, m^2.
    """
    told, moved = as_commanded(model), np.zeros((0, 3))
    for effect in told.effects:
        if {CLOCK, ORDER} & set(effect.inputs):
            others = tuple(e for e in told.effects if e is not effect)
            still = dataclasses.replace(told, effects=others)
            alone = _difference(still, told, session)
            if effect.joints:
                missed = alone - _as_moved_frame(alone, still, session)
                alone = alone * math.exp(-0.5 * float((missed**2).sum()) / variance)
            moved = alone if not len(moved) else moved + alone
    return moved - moved[-1:]


def _as_moved_frame(moved: np.ndarray, model: Model, session: Session) -> np.ndarray:
    """Return the motion of a frame, a cubic of time, that comes nearest to moves (M, 3), m."""
    rows = own_way(session)
    rows = rows.take(rows.placed)
    tips = model.tip(rows.q, rows.context())
    turns = [np.cross(axis, tips) for axis in np.eye(3)]
    rigid = np.stack([*(np.broadcast_to(axis, tips.shape) for axis in np.eye(3)), *turns], axis=-1)
    powers = rows.share_of_time[:, None] ** np.arange(4)
    design = (rigid[..., None, :] * powers[:, None, :, None]).reshape(moved.size, -1)
    return (design @ np.linalg.lstsq(design, moved.ravel(), rcond=None)[0]).reshape(moved.shape)


def _difference(less: Model, more: Model, session: Session) -> np.ndarray:
    """Return the shift (M, 3), m, of rows by the terms of `more` that `less` lacks."""
    if less.terms == more.terms:
        return np.zeros((0, 3))
    rows = own_way(session)
    placed = rows.take(rows.placed)
    at = compute_posture(less, placed)
    then = at if more.effects == less.effects else more.posture_near(at)
    return np.asarray(tip_errors_at(less, placed, at) - tip_errors_at(more, placed, then))


def as_commanded(model: Model) -> Model:
    """Return the model without what no command compensates: measuring side, what is never told.

    Frames of sensors and anchors stay: they say in which frame a row was measured.
    """
    return dataclasses.replace(
        model,
        effects=tuple(e for e in model.effects if e.commandable),
        biases=tuple(b for b in model.biases if b.geometry),
    )


def own_way(session: Session) -> Session:
    """Return the rows without moves before the last that nobody recorded: only a side was told."""
    legs = session.legs.copy()
    legs[session.told != 0, 1:] = 0.0
    return dataclasses.replace(session, legs=legs)


def not_commanded(model: Model, session: Session) -> list[str]:
    """Name what `commanded_errors` leaves out of a model at these rows."""
    said = [
        f"{term.name} {MEASURING_SIDE if isinstance(term, Bias) else NEVER_TOLD}"
        for term in model.terms
        if not term.geometry and not term.commandable
    ]
    reads = [e for e in model.effects if "legs" in e.inputs]
    if reads and session.legs[session.told != 0, 1:].any():
        said.append(f"earlier moves of the joints ({reads[0].name})")
    return list(dict.fromkeys(said))
