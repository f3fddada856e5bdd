"""What a model needs of the circumstances and a command cannot know: said, never filled in."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from longarm_comp.core.arm.context import LEGS, PER_JOINT, Context
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.ik.forward import tip_poses
from longarm_comp.core.model.model import Model

_LEAST_M = 1e-5
"""A tip that moves by less, whatever the joints did before, does not depend on it."""


def missing_column(model: Model, context: Context) -> str:
    """Which recorded quantity an effect of the model needs and the context lacks, or ""."""
    for effect in model.effects:
        for name in effect.inputs:
            if name not in PER_JOINT and not context.has(name):
                return f"{name} is not known, and {effect.name} of the model needs it"
    return ""


def outside_data(model: Model, q: np.ndarray, context: Context) -> str:
    """Which effects stand outside the data that they were found in, and in what; or "".

    They count there as at the end of the data.
    """
    bounded = [e for e in model.effects if e.bounded]
    if not bounded:
        return ""
    posture = model.posture(tuple(q.tolist()), context)
    beyond = {part for effect in bounded for part in effect.outside(posture)}
    return f"outside the data of what was found: {', '.join(sorted(beyond))}" if beyond else ""


def history_joints(model: Model) -> dict[str, tuple[int, ...]]:
    """Per-joint fields that effects of the model read, and of which joints (0-based)."""
    read: dict[str, set[int]] = {}
    for effect in model.effects:
        for name in effect.inputs:
            if name in PER_JOINT:
                read.setdefault(name, set()).update(effect.history_joints(model.arm))
    return {name: tuple(sorted(joints)) for name, joints in read.items()}


def unknown_history(
    model: Model, q: np.ndarray, context: Context, doubtful: np.ndarray | None = None
) -> tuple[np.ndarray, str]:
    """How far the tip depends on what is not known of the joints' history.

    Args:
        q: (n,) commanded joints, rad and m.
        context: circumstances at q.
        doubtful: (n,) joints whose side of arrival is told but not certain.

    Returns:
        Standard deviation (3,) in m, and which fields of which joints in one sentence; zeros and
        "" where everything that matters is known.
    """
    n = model.arm.n
    unsure = np.zeros(n, bool) if doubtful is None else doubtful
    known = {name: np.reshape(context.of_all(name, n), (n, -1)) for name in PER_JOINT}
    open_ = [
        (name, joint, extremes)
        for name, joints in history_joints(model).items()
        for joint in joints
        if (extremes := _EXTREMES[name](known[name][joint], bool(unsure[joint]))) is not None
    ]
    if not open_:
        return np.zeros(3), ""
    trials = {name: np.repeat(held[None], 2 * len(open_), axis=0) for name, held in known.items()}
    for k, (name, joint, extremes) in enumerate(open_):
        trials[name][2 * k : 2 * k + 2, joint] = extremes
    columns = {name: np.full(2 * len(open_), value) for name, value in context.columns.items()}
    history = {name: tuple(rows.reshape(len(rows), -1).T) for name, rows in trials.items()}
    supposed = Context(**history, columns=columns, labels=context.labels)
    tip = tip_poses(model, np.tile(q, (2 * len(open_), 1)), supposed)[:, :3, 3]
    half = 0.5 * (tip[0::2] - tip[1::2])
    size = np.linalg.norm(half, axis=1)
    if not (size > _LEAST_M).any():
        return np.zeros(3), ""
    spread = np.sqrt((half**2).sum(axis=0))
    names = model.arm.joint_names
    parts = [
        f"{_WORDS[name]} of {names[joint]}"
        for (name, joint, _), moved in zip(open_, size, strict=True)
        if moved > _LEAST_M
    ]
    sigma_mm = 1e3 * float(np.linalg.norm(spread))
    why = f"the tip depends on what is not known: {', '.join(parts)} (sigma {sigma_mm:.2f} mm)"
    return spread, why


def uncertain_payload(model: Model, q: np.ndarray, context: Context) -> tuple[np.ndarray, str]:
    """How far the tip depends on a payload that is known to `SD` only: as `unknown_history`."""
    sd = float(context.column(SD, 0.0))  # type: ignore[arg-type]
    if not sd:
        return np.zeros(3), ""
    kg = context.payload_kg(0.0) + sd * np.array([1.0, -1.0])
    told = dataclasses.replace(context, columns={**context.columns, "payload_kg": kg})
    tips = [model.tip(q, told.take(k)) for k in range(2)]
    half = np.abs(tips[0] - tips[1]) / 2.0
    mm = 1e3 * float(np.linalg.norm(half))
    return half, f"the payload is known to {sd:.3f} kg only (sigma {mm:.2f} mm)"


def _either_side(side: np.ndarray, unsure: bool) -> np.ndarray | None:
    """Both sides (2, 1), where the side is not known."""
    return np.array([[1.0], [-1.0]]) if unsure or side[0] == 0.0 else None


def _any_way_before(legs: np.ndarray, unsure: bool) -> np.ndarray:
    """The known legs (LEGS,) after a long way up and after one down, (2, LEGS).

    Between the two lies every state that play of any radius can have.
    """
    after = np.zeros(0) if unsure else legs[legs != 0.0]
    made = np.zeros((2, LEGS))
    made[:, : len(after)] = after
    made[:, len(after)] = _FAR, -_FAR
    return made


_WORDS = {"approach": "approach", "legs": "earlier moves"}
_FAR = 1e3  # rad, m: farther than any play
_EXTREMES: Mapping[str, Callable[[np.ndarray, bool], np.ndarray | None]] = {
    "approach": _either_side,
    "legs": _any_way_before,
}
"""By field of the history, the two extremes of what it may be at a joint; None: it is known."""
