"""Circumstances that a model needs and a command does not know: what they add to its error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
    each = (
        unknown_history(model, q, context, doubtful),
        uncertain_payload(model, q, context),
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
        values = np.array([np.broadcast_to(v, m) for v in context.of_all(name, n)], float)
        recorded[name] = values.T.reshape(m, n, -1)
    spans = model.arm.upper - model.arm.lower

    def history_of(joint: int) -> _KnownHistory:
        held = {name: rows[:, joint] for name, rows in recorded.items()}
        return _KnownHistory(**held, unsure=bool(unsure[joint]), span=float(spans[joint]))

    open_ = [
        (name, joint, extremes)
        for name, joints in read.items()
        for joint in joints
        if (extremes := _FIELDS[name][1](history_of(joint))) is not None
    ]
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
    parts = [f"{_FIELDS[name][0]} of {model.arm.joint_names[joint]}" for name, joint, _ in open_]
    text = "the tip depends on circumstances that are not known"
    why = [
        f"{text}: {', '.join(compress(parts, of))} (sigma {sigma:.2f} mm)" if sigma else ""
        for of, sigma in zip((size > _LEAST_M).T, 1e3 * np.linalg.norm(spread, axis=1), strict=True)
    ]
    return spread, why


def uncertain_payload(
    model: Model, q: np.ndarray, context: Context
) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be because of the payload's uncertainty, the column `SD`.

    Returns:
        Standard deviations (M, 3) in m, and M sentences; zeros and "" for a certain payload.
    """
    sd = np.broadcast_to(context.columns.get(SD, 0.0), len(q))
    moved = moved_by_payload(model, q, context)
    return np.abs(moved), [
        f"the payload is known to {by:.3f} kg only (sigma {mm:.2f} mm)" if by else ""
        for by, mm in zip(sd, 1e3 * np.linalg.norm(moved, axis=1), strict=True)
    ]


def moved_by_payload(model: Model, q: np.ndarray, context: Context) -> np.ndarray:
    """Return the change (M, 3) of the tip, m, if the payload is one standard deviation heavier."""
    sd = np.broadcast_to(context.columns.get(SD, 0.0), len(q))
    if not sd.any():
        return np.zeros((len(q), 3))
    columns, kg = context.columns, context.payload_kg(0.0)
    tips = [
        model.tip(q, dataclasses.replace(context, columns={**columns, "payload_kg": kg + by}))
        for by in (sd, -sd)
    ]
    return np.asarray((tips[0] - tips[1]) / 2.0)


@dataclass(frozen=True)
class _KnownHistory:
    """What is known of one joint's history at M commands; fields as in `History`.

    Attributes:
        approach, last_way: (M, 1).
        legs: (M, LEGS).
        unsure: whether `approach` is given but not certain.
        span: range of the joint, rad or m.
    """

    approach: np.ndarray
    legs: np.ndarray
    last_way: np.ndarray
    unsure: bool
    span: float


def _list_sides(joint: _KnownHistory) -> np.ndarray | None:
    """Return the two extremes (2, M, 1) of the side: both sides, or twice the known one.

    None is returned if the side is known at all M commands.
    """
    unknown = (joint.approach == 0.0) | joint.unsure
    return np.where(unknown, [[[1.0]], [[-1.0]]], joint.approach) if unknown.any() else None


def _list_ways_before(joint: _KnownHistory) -> np.ndarray:
    """Return two extremes (2, M, LEGS) of the earlier moves: a long one up, and a long one down.

    Each comes before the known legs. Every possible state of a joint's play lies between the two.
    """
    legs = joint.legs
    first = np.argsort(legs == 0.0, axis=1, kind="stable")
    after = np.zeros_like(legs) if joint.unsure else np.take_along_axis(legs, first, axis=1)
    made = np.stack([after, after])
    made[:, np.arange(len(legs)), (after != 0.0).sum(axis=1)] = [[_FAR], [-_FAR]]
    return made


def _list_rests_of_way(joint: _KnownHistory) -> np.ndarray:
    """Return two extremes (2, M, 1) of the last displacement: twice the known one, and none.

    It is not known how soon after its move the tip is used. So the after-effect of the move may be
    larger than it was in the session, or gone.  If no displacement is known, the extremes are half
    the joint's range up and down. (Displacements between random positions in the range have a
    standard deviation of 0.41 of it.)
    """
    half = 0.5 * joint.span
    known = np.stack([2.0 * joint.last_way, np.zeros_like(joint.last_way)])
    return np.where(joint.legs[:, :1] == 0.0, [[[half]], [[-half]]], known)


_FAR = 1e6  # rad, m: farther than any play
_FIELDS: Mapping[str, tuple[str, Callable[[_KnownHistory], np.ndarray | None]]] = {
    "approach": ("approach", _list_sides),
    "legs": ("earlier moves", _list_ways_before),
    "last_way": ("time since the last move", _list_rests_of_way),
}
"""By field of the history: its name in messages, and the function that returns the two extremes of
its value at a joint, or None if it is known."""
