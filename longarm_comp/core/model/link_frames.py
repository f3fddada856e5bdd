"""Frames of an arm's links by the names of its URDF, and keep-out boxes that the arm enters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from longarm_comp.core.arm import quaternion
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.joint import Joint
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.model.tip_motion import stack
from longarm_comp.math.cubic_path import split


def outline(model: Model, q: np.ndarray, context: Context | None = None) -> np.ndarray:
    """Return the arm's centre-line (..., k, 3), m, base frame, at q (n,) or (N, n).

    Its points are the stations from the foot to the tip. Effects of circumstances that the context
    does not hold are left out.
    """
    context = context or Context()
    model = model.told_by(context)
    posture = model.posture(unstack(q), context)
    chain = posture.frames[: min(model.chain.spots.values())]  # what carries markers is among it
    points = [stack(frame.p) for frame in (*chain, model.tip_frame(posture))]
    shape = (*np.shape(q)[:-1], 3)
    return np.stack([np.broadcast_to(point, shape) for point in points], axis=-2)


def reach(model: Model) -> tuple[np.ndarray, float]:
    """Return the position (3,) of the arm's foot, m, and a bound of the tip's distance from it, m.

    The bound is the length of the outline at mid range plus the full range of every slide.
    """
    arm = model.arm
    line = outline(model, arm.mid)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    return line[0], float(length + (arm.upper - arm.lower)[arm.slides].sum())


def exaggerate_sag(hanging: np.ndarray, declared: np.ndarray, factor: float) -> np.ndarray:
    """Return the points (k, 3) of an arm with its sag (hanging - declared) enlarged by a factor."""
    return np.asarray(declared + factor * (hanging - declared))


BASE_LINK, TIP = "base_link", "tip"


@dataclass(frozen=True)
class Placed:
    """A named frame in its parent: position (3,), m, and orientation as a quaternion x, y, z, w."""

    parent: str
    name: str
    position: np.ndarray
    turn: np.ndarray

    @classmethod
    def at(cls, parent: str, name: str, pose: np.ndarray) -> Placed:
        """Return the frame of a pose (4, 4)."""
        return cls(parent, name, pose[:3, 3], quaternion.from_rotation(pose[:3, :3]))


def joint_name(joint: Joint) -> str:
    """Return the name of a row's joint: its own, or ``joint`` and the row's id."""
    return joint.name or f"joint{joint.id}"


def link_name(joint: Joint) -> str:
    """Return the name of the link that a row's joint moves."""
    return f"{joint_name(joint)}_link"


def link_frames(model: Model, q: np.ndarray, prefix: str = "") -> list[Placed]:
    """Return every link's frame in the link before it, and the tip in the last, at joints q (n,).

    The frame of a link is that of its row; the first parent is `BASE_LINK`, the measuring frame.
    Rows off the chain, which only lead others, have none. Every name starts with ``prefix``.
    """
    posture = model.posture(unstack(q))
    moving = [joint for joint in model.arm.joints if joint.moves]
    links = [(link_name(j), posture.frames[posture.frame(j.id)].matrix()) for j in moving]
    chain = [(BASE_LINK, np.eye(4)), *links, (TIP, model.tip_frame(posture).matrix())]
    return [
        Placed.at(prefix + parent, prefix + name, np.linalg.inv(before) @ pose)
        for (parent, before), (name, pose) in pairwise(chain)
    ]


_LOOK_M = 0.005
"""Depth (m) in a box up to which the check may miss the arm; half the box's thickness if less."""
_AT_ONCE = 64
"""Largest number of parts into which a piece of a motion is cut at a time: so many postures take
about as long as one."""
_TOGETHER = 4096
"""Largest number of postures that are checked at a time: it limits the memory."""
_MOST_LOOKS = 100_000
"""Number of postures after which the check of a motion gives up: some seconds."""
_DRIVERS_LOOKS = 800
"""The same number for a driver, which does nothing else meanwhile: 45 ms with five boxes."""
_TOO_LONG = (
    "keep_out: so long a way so near a box takes too long to check; allowed: shorter parts of it, "
    "or a thicker box"
)


def describe_entry(model: Model, path: np.ndarray) -> str:
    """Say which box a move enters, where, and at which joints; empty if it enters none.

    The arm is the line through its stations, from the foot to the tip: a box must be larger than
    the thing that it protects by the arm's radius. Joints move linearly between way-points.

    Args:
        path: (N, n) way-points, rad and m.
    """
    return find_entry(model, path)[1]


def find_entry(model: Model, path: np.ndarray, most: int = _MOST_LOOKS) -> tuple[int, str]:
    """Return at which row a move through joints (N, n) enters a box, and `describe_entry`.

    The entry is between the row before and this one; without an entry it is 0 and "". The move is
    cut into ever smaller pieces until the arm cannot be in a box by `_LOOK_M` unnoticed: then no
    part of it moves farther in a piece than its distances from the boxes at both ends together
    (adaptive collision checking, Schwarzer, Saha and Latombe 2005).

    Args:
        most: number of postures after which the check gives up; the text then says so.
    """
    if not model.arm.keep_out or not len(path):
        return 0, ""
    model = model.commandable  # a servo's rounding is no motion on the way
    far = most_motion(model)
    turned = np.cumsum(np.abs(np.diff(path, axis=0, prepend=path[:1])), axis=0)
    at = turned @ far.max(axis=0)
    new = np.linspace(0.0, at[-1], _AT_ONCE + 1) if at[-1] > 0.0 else at[:1]
    known, clear = np.zeros(0), np.zeros((0, len(far)))
    while len(new):
        if len(known) + len(new) > most:
            return len(path) - 1, _TOO_LONG
        q = _between(at, path, new)
        entered, distances = _entries(model, q)
        for k in (k for k, found in enumerate(entered) if found):
            joints = ", ".join(f"{number:.3g}" for number in q[k])
            return int(np.searchsorted(at, new[k])), f"keep_out {entered[k]}, at joints {joints}"
        order = np.argsort(np.concatenate([known, new]))
        known, clear = (np.concatenate(pair)[order] for pair in ((known, new), (clear, distances)))
        moved = np.diff(_between(at, turned, known), axis=0) @ far.T
        allowed = clear[1:] + clear[:-1]
        # Pieces half as long as allowed: fewer rounds
        pieces = np.where(moved > allowed, np.ceil(2.0 * moved / allowed), 1.0).max(axis=1)
        places = split(np.minimum(pieces, _AT_ONCE).astype(int))
        new = np.interp(places[places % 1 > 0], np.arange(len(known)), known)[:_TOGETHER]
    return 0, ""


def _between(at: np.ndarray, rows: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate rows (N, n), known at positions `at` (N,), at `places` (M,); return (M, n)."""
    return np.stack([np.interp(places, at, column) for column in rows.T], axis=-1)


def most_motion(model: Model) -> np.ndarray:
    """Return (parts, n), m: how far each part of `outline` moves at most per unit of each joint.

    The last part is the tip alone.
    """
    if "most_motion" not in model.memo:
        model.memo["most_motion"] = _turning(model)[1:] + _bound_change(model, model.with_terms(()))
    found: np.ndarray = model.memo["most_motion"]
    return found


def most_sagging(model: Model) -> np.ndarray:
    """Return (parts, n), m: the part of `most_motion` by which the sag changes."""
    if "most_sagging" not in model.memo:
        model.memo["most_sagging"] = _bound_change(model, model.rigid)
    found: np.ndarray = model.memo["most_sagging"]
    return found


def _turning(model: Model) -> np.ndarray:
    """Return (points of the line, n): `most_motion` of the arm without sag."""
    arm, line = model.arm, _lines(model, model.arm.mid)
    moved, span = np.abs(arm.mixing[0]), arm.upper - arm.lower
    along = np.insert(np.linalg.norm(np.diff(line, axis=0), axis=1), 0, 0.0)
    bearings = [row.bearing for row in model.chain.rows]
    for joint, bearing, weights in zip(arm.joints, bearings, moved, strict=True):
        along[bearing + 1] += 0.5 * weights @ span * (joint.type == "prismatic")
    along, far = np.cumsum(along), np.zeros((len(along), arm.n))
    for joint, bearing, weights in zip(arm.joints, bearings, moved, strict=True):
        lever = along[bearing:] - along[bearing]
        slid = np.ones_like(lever)
        far[bearing:] += np.outer(slid if joint.type == "prismatic" else lever, weights)
    return far


def _bound_change(model: Model, bare: Model) -> np.ndarray:
    """Return (parts, n): how much farther than those of another model the parts move at most.

    It is estimated as twice the largest value at 32 random postures.
    """
    arm = model.arm
    if model.effects == bare.effects:
        return np.zeros((len(_lines(model, arm.mid)) - 1, arm.n))
    here = np.random.default_rng(0).uniform(arm.lower, arm.upper, (32, arm.n))
    most = []
    for step in np.diag(1e-3 * (arm.upper - arm.lower)):
        before, after = (_lines(model, q) - _lines(bare, q) for q in (here, here + step))
        most.append(np.linalg.norm(after - before, axis=-1).max(axis=0) / step.max())
    return np.maximum.accumulate(2.0 * np.array(most).T, axis=0)[1:]


def keeper(model: Model, names: list[str], where: str) -> Callable[[np.ndarray], str] | None:
    """Return a check of motions against the boxes, or None if the arm has no box.

    The check takes joints (N, n) in the order of `names`, and says why the arm must not move
    through them, or "".

    Args:
        where: where the names are from, for error messages.
    """
    if not model.arm.keep_out:
        return None
    order = model.arm.order(names, where)
    most_motion(model.commandable)  # kept with the model: the first check is as fast as the others
    return lambda q: find_entry(model, q[:, order], _DRIVERS_LOOKS)[1]


def boxes_entered(model: Model, q: np.ndarray) -> list[str]:
    """Say for each posture q (M, n) which box of arm.yaml the arm is in, and where, or "".

    The foot may be inside a box, such as a floor whose surface is above the foot. The arm may leave
    that box once; the rest of the arm and the tip must be outside.
    """
    return _entries(model, q)[0]


def _lines(model: Model, q: np.ndarray) -> np.ndarray:
    """Return the outlines with the tip repeated, so that the last part is the tip alone."""
    line = outline(model, q)
    return np.concatenate([line, line[..., -1:, :]], axis=-2)


def _entries(model: Model, q: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Return `boxes_entered`, and how far each part may move before it must be checked again.

    The latter is (M, parts), m: the distance from the boxes, or at least the depth that may go
    unnoticed (`_LOOK_M`). For a part that leaves the box of the foot it is the depth of its
    beginning in that box.
    """
    lines = _lines(model, q)
    found, clear = [""] * len(q), np.full(lines[:, 1:, 0].shape, np.inf)
    for name, box in model.arm.keep_out.items():
        below = np.logical_and.accumulate(box.holds(lines), axis=-1)
        leaves = below[:, :-1] & ~below[:, -1:]
        outside = box.clearance(lines)
        free = np.where(leaves, box.depth(lines[:, :-1]), outside)
        clear = np.minimum(clear, np.maximum(free, min(_LOOK_M, 0.5 * box.thickness)))
        parts = (outside == 0.0) & ~leaves
        for k in np.flatnonzero(parts.any(axis=-1)):
            near = ", ".join(f"{number:.3g}" for number in lines[k, np.argmax(parts[k]) + 1])
            found[k] = found[k] or f"{name}: the arm would enter it near {near} m"
    return found, clear
