"""What a model needs of the circumstances and a command cannot know: said, never filled in."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.context import EXTREME, PER_JOINT, Context
from longarm_comp.core.model.model import Model

LEAST_M = 1e-5
"""A tip that moves by less, whatever the joints did before, does not depend on it."""


def missing_column(model: Model, context: Context) -> str:
    """Which recorded quantity an effect of the model needs and the context lacks, or ""."""
    for effect in model.effects:
        for name in effect.inputs:
            if name not in PER_JOINT and not context.has(name):
                return f"{name} is not known, and {effect.name} of the model needs it"
    return ""


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
    open_ = [
        (name, joint)
        for name, joints in history_joints(model).items()
        for joint in joints
        if unsure[joint] or context.of_joint(name, joint) == 0.0
    ]
    if not open_:
        return np.zeros(3), ""
    trials = {name: np.empty((2 * len(open_), n)) for name in PER_JOINT}
    for name, rows in trials.items():
        rows[:] = [context.of_joint(name, joint) for joint in range(n)]
    for k, (name, joint) in enumerate(open_):
        trials[name][2 * k : 2 * k + 2, joint] = EXTREME[name], -EXTREME[name]
    columns = {name: np.full(2 * len(open_), value) for name, value in context.columns.items()}
    history = {name: tuple(rows.T) for name, rows in trials.items()}
    tip = model.tip(
        np.tile(q, (2 * len(open_), 1)),
        Context(**history, columns=columns, labels=context.labels),
    )
    half = 0.5 * (tip[0::2] - tip[1::2])
    size = np.linalg.norm(half, axis=1)
    if not (size > LEAST_M).any():
        return np.zeros(3), ""
    spread = np.sqrt((half**2).sum(axis=0))
    names = model.arm.joint_names
    parts = [
        f"{name} of {names[joint]}"
        for (name, joint), moved in zip(open_, size, strict=True)
        if moved > LEAST_M
    ]
    sigma_mm = 1e3 * float(np.linalg.norm(spread))
    why = f"the tip depends on what is not known: {', '.join(parts)} (sigma {sigma_mm:.2f} mm)"
    return spread, why
