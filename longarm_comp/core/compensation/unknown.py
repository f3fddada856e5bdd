"""Circumstances that a model needs and a command cannot know: they are reported, never assumed."""

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
"""Why it gives no command, where it holds what went on while the session was measured."""
_LEAST_M = 1e-5
"""A tip that moves by less, whatever the joints did before, does not depend on it."""


def missing_column(model: Model, context: Context) -> str:
    """Name a recorded quantity that an effect of the model needs and the context lacks, or ""."""
    for effect in model.effects:
        if name := effect.missing(context):
            if name == CLOCK:
                return f"{NO_END} (it holds {effect.name})"
            return f"{name} is not known, and {effect.name} of the model needs it"
    return ""


def unknown_circumstances(
    model: Model, q: np.ndarray, context: Context, doubtful: np.ndarray | None = None
) -> tuple[np.ndarray, list[str]]:
    """Estimate how far off the tip may be by all that a command cannot know, (M, 3) m, and say why.

    The arguments are those of `unknown_history`.
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
    """List the per-joint fields that effects of the model read, and of which joints (0-based)."""
    read: dict[str, set[int]] = {}
    for effect in model.effects:
        for name in effect.inputs:
            if name in PER_JOINT:
                read.setdefault(name, set()).update(effect.history_joints(model.arm))
    return {name: tuple(sorted(joints)) for name, joints in read.items()}


def unknown_history(
    model: Model, q: np.ndarray, context: Context, doubtful: np.ndarray | None = None
) -> tuple[np.ndarray, list[str]]:
    """Estimate how far the tip depends on what is not known of the joints' history.

    Args:
        q: (M, n) commanded joints, rad and m.
        doubtful: (n,) joints whose side of arrival is told but not certain.

    Returns:
        Standard deviations (M, 3) in m, and which fields of which joints in one sentence each;
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
    """Estimate how far the tip depends on a payload known to `SD` only: as `unknown_history`."""
    sd = np.broadcast_to(context.columns[SD], len(q)) if SD in context.columns else np.zeros(0)
    if not sd.any():
        return np.zeros((len(q), 3)), [""] * len(q)
    columns, kg = context.columns, context.payload_kg(0.0)
    tips = [
        model.tip(q, dataclasses.replace(context, columns={**columns, "payload_kg": kg + by}))
        for by in (sd, -sd)
    ]
    half = np.abs(tips[0] - tips[1]) / 2.0
    return half, [
        f"the payload is known to {by:.3f} kg only (sigma {mm:.2f} mm)" if by else ""
        for by, mm in zip(sd, 1e3 * np.linalg.norm(half, axis=1), strict=True)
    ]


@dataclass(frozen=True)
class _KnownHistory:
    """The record of what is known of a joint's history at M commands (`History`).

    Attributes:
        approach, last_way: (M, 1).
        legs: (M, LEGS).
        unsure: its side is told but not certain.
        span: range of the joint, rad or m.
    """

    approach: np.ndarray
    legs: np.ndarray
    last_way: np.ndarray
    unsure: bool
    span: float


def _list_sides(joint: _KnownHistory) -> np.ndarray | None:
    """Give both sides (2, M, 1) where the side is not known, the side where it is."""
    unknown = (joint.approach == 0.0) | joint.unsure
    return np.where(unknown, [[[1.0]], [[-1.0]]], joint.approach) if unknown.any() else None


def _list_ways_before(joint: _KnownHistory) -> np.ndarray:
    """Give the known legs after a long way up and after one down, (2, M, LEGS).

    Between the two lies every state that play of any radius can have.
    """
    legs = joint.legs
    first = np.argsort(legs == 0.0, axis=1, kind="stable")
    after = np.zeros_like(legs) if joint.unsure else np.take_along_axis(legs, first, axis=1)
    made = np.stack([after, after])
    made[:, np.arange(len(legs)), (after != 0.0).sum(axis=1)] = [[_FAR], [-_FAR]]
    return made


def _list_rests_of_way(joint: _KnownHistory) -> np.ndarray:
    """Give the last way twice and not at all, (2, M, 1); where no way is known, half the joint's
    range up and down.

    Nobody tells how soon after its move a tip is used: what is left of the way may be more than it
    was in the session, or nothing.  Ways all over the range have a standard deviation of 0.41 of
    it.
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
"""By field of the history, its name for people, and the two extremes of what it may be at a joint;
None: all are known."""
