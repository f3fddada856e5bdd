"""Errors of commands: by how much the tip would miss its target if a model computed the command.

A session holds more than is known for a command: causes on the measuring side, earlier moves of
joints of which only the last side was recorded, and circumstances that are unknown when a command
is sent.  `compute_tip_errors` uses all of it, and this module leaves it out (docs/report.md, "As
seen and as commanded").
"""

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


def commanded_errors(
    model: Model, session: Session, near: Posture | None = None, seen: np.ndarray | None = None
) -> np.ndarray:
    """Compute measured - predicted, (M, 3) m, with a prediction from what a command knows.

    The M rows are those of `compute_tip_errors`.  The mean displacement of the fitted rows by the
    measuring side is a choice of frame (`frame_shift`) and is no error: targets are given in this
    frame too (`core/compensation/target_frame.py`).

    Args:
        near: a similar model's posture at the M rows, which saves time.
        seen: `compute_tip_errors` of the same rows, which are these if a command knows everything.
    """
    if seen is not None and is_known_to_command(model, session):
        return seen
    told = as_commanded(model)
    missed = compute_tip_errors(told, own_way(session), near)
    return missed if told.biases == model.biases else missed - model.frame_shift


def with_frame_shift(model: Model, session: Session, near: Posture | None = None) -> Model:
    """Return the model with `frame_shift` set to its biases' mean displacement of the rows, m.

    Args:
        near: a similar model's posture at the rows, which saves time.
    """
    moved = moved_by_measuring(model, session, near)
    x, y, z = moved.mean(axis=0).tolist() if len(moved) else (0.0, 0.0, 0.0)
    return dataclasses.replace(model, frame_shift=(x, y, z))


def in_frame_of_start(model: Model, session: Session) -> Model:
    """Return the model with targets in the measuring frame as it was at the session's first row.

    Without a drift of this frame the model is not changed.  The frame of the first row is used
    because points are marked before a session, and the tip does not follow the drift.
    """
    if not any(CLOCK in b.inputs for b in model.biases):
        return model
    first = np.full(len(session), session.columns[CLOCK].min())
    columns = {**session.columns, CLOCK: first}
    return with_frame_shift(model, dataclasses.replace(session, columns=columns))


def moved_by_measuring(model: Model, session: Session, near: Posture | None = None) -> np.ndarray:
    """Compute the displacement of the seen tip by the model's biases, (M, 3) m.

    The M rows are those that measure the tip's position.  Without such biases the result is (0, 3).
    The arguments are those of `with_frame_shift`.
    """
    told = as_commanded(model)
    return _difference(told, dataclasses.replace(told, biases=model.biases), session, near)


def moved_with_time(model: Model, session: Session, variance: float) -> np.ndarray:
    """Return the displacement of the tip that may be a moving frame instead of a moving arm.

    It is the displacement (M, 3), m, by the model's effects that depend on time, because
    measurements cannot distinguish a base or marker that moved from a camera that moved.  It is
    relative to the last row, because commands start from the arm at the end of the session.  An
    effect at a joint is weighted by the likelihood ratio of the best moving frame to the effect.

    Args:
        variance: variance of the noise of a coordinate, m^2.
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
    """Return the displacements by a moving frame that are closest to given ones (M, 3), m.

    Position and rotation of the frame are cubic polynomials of time.
    """
    rows = own_way(session)
    rows = rows.take(rows.placed)
    tips = model.tip(rows.q, rows.context())
    turns = [np.cross(axis, tips) for axis in np.eye(3)]
    rigid = np.stack([*(np.broadcast_to(axis, tips.shape) for axis in np.eye(3)), *turns], axis=-1)
    powers = rows.share_of_time[:, None] ** np.arange(4)
    design = (rigid[..., None, :] * powers[:, None, :, None]).reshape(moved.size, -1)
    return (design @ np.linalg.lstsq(design, moved.ravel(), rcond=None)[0]).reshape(moved.shape)


def _difference(
    less: Model, more: Model, session: Session, near: Posture | None = None
) -> np.ndarray:
    """Return the displacement (M, 3), m, of the rows by the terms of `more` that `less` lacks."""
    if less.terms == more.terms:
        return np.zeros((0, 3))
    rows = own_way(session)
    placed = rows.take(rows.placed)
    if near is None or len(placed) < len(rows):
        at = compute_posture(less, placed)
    else:
        at = less.posture_near(dataclasses.replace(near, context=placed.context()), close=True)
    then = at if more.effects == less.effects else more.posture_near(at)
    return np.asarray(tip_errors_at(less, placed, at) - tip_errors_at(more, placed, then))


def as_commanded(model: Model) -> Model:
    """Return the model without the terms that no command can compensate.

    These are the biases, and effects with an input that is unknown for a command.  Biases that
    place sensors and anchors stay, because they define the frame of a row.
    """
    return dataclasses.replace(
        model,
        effects=tuple(e for e in model.effects if e.commandable),
        biases=tuple(b for b in model.biases if b.geometry),
    )


def is_known_to_command(model: Model, session: Session) -> bool:
    """Tell whether a command knows all that the model and the session's rows hold."""
    earlier = session.legs[session.told != 0, 1:].any()
    return not earlier and as_commanded(model).terms == model.terms


def own_way(session: Session) -> Session:
    """Return the session without the legs before the last, for joints with only a recorded side."""
    legs = session.legs.copy()
    legs[session.told != 0, 1:] = 0.0
    return dataclasses.replace(session, legs=legs)


def not_commanded(model: Model, session: Session) -> list[str]:
    """Return the names of the terms and inputs that `commanded_errors` leaves out at these rows."""
    said = [
        f"{term.name} {MEASURING_SIDE if isinstance(term, Bias) else NEVER_TOLD}"
        for term in model.terms
        if not term.geometry and not term.commandable
    ]
    reads = [e for e in model.effects if "legs" in e.inputs]
    if reads and session.legs[session.told != 0, 1:].any():
        said.append(f"earlier moves of the joints ({reads[0].name})")
    return list(dict.fromkeys(said))
