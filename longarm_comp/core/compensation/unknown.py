"""Circumstances that a model needs and a command does not know: what they add to its error."""

import dataclasses
from itertools import compress
from typing import Any

import numpy as np

from longarm_comp.core.arm.context import CLOCK, PER_JOINT, Context
from longarm_comp.core.compensation.beyond import beyond_session
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.ik.engines import tip_poses
from longarm_comp.core.model.model import Model

NO_END = "the model does not say when its session ended: calibrate again"
"""Why a model that depends on the session's clock gives no command if this end is missing."""
_LEAST_M = 1e-5
"""The tip counts as independent of the history if it can move by no more than this, m."""


def missing_column(model: Model, context: Context) -> str:
    """Say which quantity an effect of the model needs and the context lacks; "" for none."""
    for effect in model.effects:
        if name := effect.missing(context):
            if name == CLOCK:
                return f"{NO_END} (it holds {effect.name})"
            return f"{name} is not known, and {effect.name} of the model needs it"
    return ""


def unknown_circumstances(
    model: Model, q: np.ndarray, context: Context, doubtful: np.ndarray | None = None
) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be by circumstances that a command does not know.

    They are the history, the payload, and values beyond those of the session.

    Args:
        q, context, doubtful: as in `unknown_history`.

    Returns:
        Standard deviations (M, 3) in m, and M texts that say why; zeros and "" where all is known.
    """
    heavier = moved_by_payload(model, q, context)
    known_to = np.broadcast_to(context.columns.get(SD, 0.0), len(q))
    weighed = [
        f"the payload is known to {by:.3f} kg only (sigma {mm:.2f} mm)" if by else ""
        for by, mm in zip(known_to, 1e3 * np.linalg.norm(heavier, axis=1), strict=True)
    ]
    each = (
        unknown_history(model, q, context, doubtful),
        (np.abs(heavier), weighed),
        beyond_session(model, q, context),
    )
    if not any(any(why) for _, why in each):
        return each[0]
    words = zip(*(why for _, why in each), strict=True)
    spread = np.sqrt(sum(sd**2 for sd, _ in each))
    return spread, ["; ".join(filter(None, why)) for why in words]


def history_joints(model: Model) -> dict[str, tuple[int, ...]]:
    """Return the joints (0-based) whose history the model's effects read, by field of `Context`."""
    read: dict[str, set[int]] = {}
    for effect in model.effects:
        for name in effect.inputs:
            if name in PER_JOINT:
                read.setdefault(name, set()).update(effect.history_joints(model.arm))
    return {name: tuple(sorted(joints)) for name, joints in read.items()}


def sided_joints(model: Model) -> list[int]:
    """List the joints (0-based) for which the side of arrival matters to a command.

    They are those whose history the model's effects read, and those that arrived from one side in
    all rows: what the other side does, these rows do not show.
    """
    joints = {joint for each in history_joints(model).values() for joint in each}
    if model.uncertainty is not None:
        joints |= {j for j, known in enumerate(model.arrivals) if min(known) == 0 < max(known)}
    return sorted(joints)


def unknown_history(
    model: Model, q: np.ndarray, context: Context, doubtful: np.ndarray | None = None
) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be, because the joints' history is not fully known.

    Args:
        q: (M, n) commanded joints, rad and m.
        context: circumstances of all, or of each.
        doubtful: (n,) bool, joints whose side of arrival in `context` is not certain.

    Returns:
        Standard deviations (M, 3) in m, and M sentences that name the unknown fields and joints;
        zeros and "" where everything that matters is known.
    """
    m, n = q.shape
    read = history_joints(model)
    if not any(read.values()):
        return np.zeros((m, 3)), [""] * m
    unsure = np.zeros(n, bool) if doubtful is None else doubtful
    recorded = {}
    for name in PER_JOINT:
        given = context.of_all(name, n)
        values = np.empty((len(given), m))
        for row, value in zip(values, given, strict=True):
            row[:] = value
        recorded[name] = values.T.reshape(m, n, -1)
    spans = model.arm.upper - model.arm.lower
    open_ = []
    for name, joints in read.items():
        for joint in joints:
            held = {field: rows[:, joint] for field, rows in recorded.items()}
            extremes = _find_extremes(name, **held, unsure=unsure[joint], span=spans[joint])
            if extremes is not None:
                open_.append((name, joint, extremes))
    if not open_:
        return np.zeros((m, 3)), [""] * m
    times = 2 * len(open_)
    trials = {name: np.repeat(rows[None], times, axis=0) for name, rows in recorded.items()}
    for k, (name, joint, extremes) in enumerate(open_):
        trials[name][2 * k : 2 * k + 2, :, joint] = extremes
    history: dict[str, Any] = {
        name: tuple(rows.reshape(times * m, -1).T) for name, rows in trials.items()
    }
    there = dataclasses.replace(context.take(np.tile(np.arange(m), times)), **history)
    tip = tip_poses(model, np.tile(q, (times, 1)), there)[:, :3, 3].reshape(-1, 2, m, 3)
    half = 0.5 * (tip[:, 0] - tip[:, 1])
    size = np.linalg.norm(half, axis=2)
    spread = np.where((size > _LEAST_M).any(axis=0)[:, None], np.sqrt((half**2).sum(axis=0)), 0.0)
    parts = [f"{_SAID[name]} of {model.arm.joint_names[joint]}" for name, joint, _ in open_]
    text = "the tip depends on circumstances that are not known"
    why = [
        f"{text}: {', '.join(compress(parts, of))} (sigma {sigma:.2f} mm)" if sigma else ""
        for of, sigma in zip((size > _LEAST_M).T, 1e3 * np.linalg.norm(spread, axis=1), strict=True)
    ]
    return spread, why


def moved_by_payload(model: Model, q: np.ndarray, context: Context) -> np.ndarray:
    """Return the change (M, 3) of the tip, m, if the payload is one standard deviation heavier."""
    sd = np.broadcast_to(context.columns.get(SD, 0.0), len(q))
    if not sd.any():
        return np.zeros((len(q), 3))
    columns, kg = context.columns, context.payload_kg(0.0)
    heavier, lighter = (
        dataclasses.replace(context, columns={**columns, "payload_kg": kg + by}) for by in (sd, -sd)
    )
    change = tip_poses(model, q, heavier) - tip_poses(model, q, lighter)
    return np.asarray(change[:, :3, 3] / 2.0)


def _find_extremes(
    field: str,
    *,
    approach: np.ndarray,
    legs: np.ndarray,
    last_way: np.ndarray,
    unsure: bool,
    span: float,
) -> np.ndarray | None:
    """Return two extremes (2, M, ...) of a field of one joint's history; None if it is known.

    Args:
        approach, last_way, legs: what is known of it, (M, 1) or (M, LEGS).
        unsure: whether `approach` is given but not certain.
        span: range of the joint, rad or m.
    """
    if field == "approach":
        unknown = (approach == 0.0) | unsure
        return np.where(unknown, [[[1.0]], [[-1.0]]], approach) if unknown.any() else None
    if field == "legs":
        # A long way up, and a long way down, before the known legs. Every possible state of a
        # joint's play lies between the two.
        first = np.argsort(legs == 0.0, axis=1, kind="stable")
        after = np.zeros_like(legs) if unsure else np.take_along_axis(legs, first, axis=1)
        made = np.stack([after, after])
        made[:, np.arange(len(legs)), (after != 0.0).sum(axis=1)] = [[_FAR], [-_FAR]]
        return made
    # It is not known how soon after its move the tip is used. So the after-effect of the move may
    # be larger than it was in the session, or gone. If no displacement is known, the extremes are
    # half the joint's range up and down. (Displacements between random positions in the range have
    # a standard deviation of 0.41 of it.)
    known = np.stack([2.0 * last_way, np.zeros_like(last_way)])
    return np.where(legs[:, :1] == 0.0, [[[0.5 * span]], [[-0.5 * span]]], known)


_FAR = 1e6  # rad, m: farther than any play
_SAID = {
    "approach": "approach",
    "legs": "earlier moves",
    "last_way": "time since the last move",
}
"""Names of the history's fields in messages."""
