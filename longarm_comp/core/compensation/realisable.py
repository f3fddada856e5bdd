"""Joints that the servos can stand at, chosen together so that the tip is nearest to its target.

A servo stands at ``offset + step k`` for whole k.  Rounding each joint by itself wastes what the
joints can do together: near the ideal joints q* there are commands whose tip is far nearer.  With
e0 the tip's error at q* and J its derivative, those k are looked for (`lattice`) that minimise

    |J (offset + step k - q*) + e0|^2 + |price (offset + step k - q*)|^2,   inside the limits;

the best of them, and plain rounding, are judged by the model itself, and the model is linearised
again at the best.  Joints without a step are solved for beside them.  The price of movement keeps
the command near q*; rounding moves least, so what is chosen is never further from the target.

For moves from point to point: neighbouring targets get joints up to a degree apart, so a path of
close targets is smoother with rounding (docs/realisable.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.lattice_search import EDGE, LatticeProblem, Predict, Search
from longarm_comp.core.errors import InputError

__all__ = ["KNOWN_TO", "Lattice", "Predict", "Realisable", "Search", "choose"]

KNOWN_TO = 0.15
"""Share of a step to which a lattice's offset must be known (standard deviation)."""


@dataclass(frozen=True)
class Lattice:
    """Where the servos can stand: joint j at ``offset[j] + step[j] k`` for whole k.

    Attributes:
        step: (n,) rad or m; 0: the joint is continuous.
        offset: (n,) rad or m.
        offset_sd: (n,) rad or m, standard deviation to which the offset is known.
    """

    step: np.ndarray
    offset: np.ndarray
    offset_sd: np.ndarray

    @classmethod
    def of(cls, arm: Arm, offset: Any = 0.0, offset_sd: Any = 0.0) -> Lattice:
        """The steps that an arm declares, with an offset for all joints or for each, (n,)."""
        made = [arm.steps]
        for name, value in (("offset", offset), ("offset_sd", offset_sd)):
            given = np.asarray(value, float)
            if given.shape not in ((), (arm.n,)):
                allowed = f"one number or ({arm.n},)"
                raise InputError("realisable", name, f"shape {given.shape}", allowed)
            if not np.isfinite(given).all() or (name == "offset_sd" and (given < 0).any()):
                allowed = "finite numbers" + (" of 0 or more" if name == "offset_sd" else "")
                raise InputError("realisable", name, given.tolist(), allowed)
            made.append(np.broadcast_to(given, (arm.n,)))
        return cls(*made)

    @property
    def known(self) -> np.ndarray:
        """(n,) bool: the joint has steps, and it is known well enough where they are."""
        made: np.ndarray = (self.step > 0) & (self.offset_sd <= KNOWN_TO * self.step)
        return made


@dataclass(frozen=True)
class Realisable:
    """What was chosen for one target.

    Attributes:
        joints: (n,) to command, inside the limits.
        ideal: (n,) as they were asked for.
        rounded: (n,) the ideal with each joint rounded by itself.
        ideal_error, rounded_error, error: predicted tip error at each of the three: m, and rad (0
            for positions).
        nodes: of the search trees.
        on_lattice: (n,) bool, joints that were chosen among their steps.
        reason: why nothing better than rounding was chosen; empty where something was.
        note: which joints with steps stay at their ideal value, and why; empty where none.
    """

    joints: np.ndarray
    ideal: np.ndarray
    rounded: np.ndarray
    ideal_error: np.ndarray
    rounded_error: np.ndarray
    error: np.ndarray
    nodes: int
    on_lattice: np.ndarray
    reason: str
    note: str


def choose(
    arm: Arm,
    lattice: Lattice,
    predict: Predict,
    targets: np.ndarray,
    ideal: np.ndarray,
    search: Search,
    *,
    locked: Sequence[int] = (),
) -> list[Realisable]:
    """Realisable joints for each of N targets, the tip as near to the target as they let it be.

    Args:
        arm: its limits hold exactly.
        lattice: where its servos can stand; a joint whose offset is not known to `KNOWN_TO` of its
            step stays at its ideal value.
        predict: the model, with all that is expected of the tip: learned error, circumstances.
        targets: positions (N, 3) in m or poses (N, 4, 4), base frame.
        ideal: (N, n) joints that bring the tip to the targets, inside the limits.
        locked: 0-based numbers of joints that stay at their ideal value.
    """
    targets, ideal = np.asarray(targets, float), np.asarray(ideal, float)
    _check(arm, targets, ideal, locked)
    held = np.isin(np.arange(arm.n), locked)
    low, high = _whole_limits(arm, lattice)
    declared = (lattice.step > 0) & ~held
    stepped = declared & lattice.known & (low <= high)
    slides = np.array([arm.joints[i - 1].type == "prismatic" for i in arm.commanded])
    problem = LatticeProblem(
        arm.lower,
        arm.upper,
        np.flatnonzero(stepped),
        np.flatnonzero((lattice.step == 0) & ~held),
        lattice.offset[stepped],
        lattice.step[stepped],
        low[stepped],
        high[stepped],
        search.price_m / np.where(slides, search.length_m, 1.0),
    )
    joints, rounded, errors, nodes = problem.solve(predict, targets, ideal, search)
    why = "no choice was better than rounding" if stepped.any() else "no joint's steps are known"
    note = _note(arm, declared & ~lattice.known, declared & lattice.known & (low > high))
    better = (joints != rounded).any(axis=1)
    return [
        Realisable(
            joints[i], ideal[i], rounded[i], errors[i, 0], errors[i, 1], errors[i, 2],
            int(nodes[i]), stepped, "" if better[i] else why, note,
        )
        for i in range(len(joints))
    ]  # fmt: skip


def _whole_limits(arm: Arm, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest k inside the limits, (n,); of a continuous joint, of no use."""
    step = np.where(lattice.step > 0, lattice.step, 1.0)
    low = np.ceil((arm.lower - lattice.offset) / step - EDGE)
    return low, np.floor((arm.upper - lattice.offset) / step + EDGE)


def _note(arm: Arm, unknown: np.ndarray, empty: np.ndarray) -> str:
    made = []
    for mask, why in (
        (unknown, f"the offset of its steps is not known to {KNOWN_TO} of a step"),
        (empty, "none of its steps lies inside its limits"),
    ):
        names = [name for name, m in zip(arm.joint_names, mask, strict=True) if m]
        made += [f"{name} stays at its ideal value: {why}" for name in names]
    return "; ".join(made)


def _check(arm: Arm, targets: np.ndarray, ideal: np.ndarray, locked: Sequence[int]) -> None:
    where = "realisable"
    if targets.ndim not in (2, 3) or targets.shape[1:] not in ((3,), (4, 4)):
        allowed = "shape (N, 3) or (N, 4, 4)"
        raise InputError(where, "targets", f"shape {targets.shape}", allowed)
    if ideal.shape != (len(targets), arm.n):
        raise InputError(where, "ideal", f"shape {ideal.shape}", f"shape {(len(targets), arm.n)}")
    for name, values in (("target", targets), ("ideal joints", ideal)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
        if bad.size:
            i = int(bad[0])
            raise InputError(where, f"{name} {i}", values[i].tolist(), "finite numbers")
    outside = ((ideal < arm.lower - EDGE) | (ideal > arm.upper + EDGE)).any(axis=1)
    if outside.any():
        i = int(np.flatnonzero(outside)[0])
        allowed = f"{arm.lower.tolist()} to {arm.upper.tolist()}"
        raise InputError(where, f"ideal joints {i}", ideal[i].tolist(), allowed)
    for joint in locked:
        if not 0 <= joint < arm.n:
            raise InputError(where, "locked", joint, f"0..{arm.n - 1}")
