"""Places of an arm's links, by the names of its URDF, and the boxes that they enter."""

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


def outline(model: Model, q: np.ndarray, context: Context | None = None) -> np.ndarray:
    """Points (..., k, 3) m, base frame: every station from the foot to the tip, at q (..., n).

    Effects of circumstances that the context does not hold are left out.
    """
    context = context or Context()
    model = model.told_by(context)
    posture = model.posture(unstack(q), context)
    points = [stack(frame.p) for frame in (*posture.frames, model.tip_frame(posture))]
    shape = (*np.shape(q)[:-1], 3)
    return np.stack([np.broadcast_to(point, shape) for point in points], axis=-2)


def reach(model: Model) -> tuple[np.ndarray, float]:
    """Return where the arm stands (3,), and how far the tip can be from there at most, m.

    It is the length of its outline with every slide driven out.
    """
    arm = model.arm
    line = outline(model, arm.mid)
    slides = [arm.joints[row - 1].type == "prismatic" for row in arm.commanded]
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    return line[0], float(length + (arm.upper - arm.lower)[slides].sum())


def exaggerate_sag(hanging: np.ndarray, declared: np.ndarray, factor: float) -> np.ndarray:
    """Points (k, 3) of an arm whose sag is enlarged by a factor."""
    return np.asarray(declared + factor * (hanging - declared))


BASE_LINK, TIP = "base_link", "tip"


@dataclass(frozen=True)
class Placed:
    """A frame in its parent: (3,) m and the orientation x, y, z, w."""

    parent: str
    name: str
    position: np.ndarray
    turn: np.ndarray

    @classmethod
    def at(cls, parent: str, name: str, pose: np.ndarray) -> Placed:
        """Return the frame of a pose (4, 4)."""
        return cls(parent, name, pose[:3, 3], quaternion.from_rotation(pose[:3, :3]))


def joint_name(joint: Joint) -> str:
    """Name of a row's joint: its own, or by its number."""
    return joint.name or f"joint{joint.id}"


def link_name(joint: Joint) -> str:
    """Name of the link that a row's joint moves."""
    return f"{joint_name(joint)}_link"


def link_frames(model: Model, q: np.ndarray, prefix: str = "") -> list[Placed]:
    """Every link of the chain in the one before, and the tip in the last, at joints q (n,).

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


def describe_entry(model: Model, path: np.ndarray) -> str:
    """Say which box a move enters, where, and at which joints; empty if it enters none.

    The arm is the line through its stations, from the foot to the tip: a box must be larger than
    the thing that it protects by the arm's radius. Between way-points joints move straight.
    """
    # Postures looked at from one way-point to the next
    shares = np.linspace(0.0, 1.0, 16 + 1)[1:, None]
    for start, end in pairwise(path) if model.arm.keep_out else ():
        if found := entered_at(model, start + shares * (end - start)):
            return found
    return ""


def entered_at(model: Model, q: np.ndarray) -> str:
    """Name the first keep-out box that the arm enters at postures (M, n), and the joints; "" if
    none."""
    for joints, found in zip(q.tolist(), boxes_entered(model, q), strict=True):
        if found:
            at = ", ".join(f"{number:.3g}" for number in joints)
            return f"keep_out {found}, at joints {at}"
    return ""


def keeper(model: Model, names: list[str], where: str) -> Callable[[np.ndarray], str] | None:
    """Return `entered_at` of joints (M, n) in the order of their names; None without boxes."""
    if not model.arm.keep_out:
        return None
    order = model.arm.order(names, where)
    return lambda q: entered_at(model, q[:, order])


def boxes_entered(model: Model, q: np.ndarray) -> list[str]:
    """Say, for each of the postures q (M, n): the box of arm.yaml that the arm is in, and where.

    A box that the arm's foot stands in, as a floor above the foot, is left once: what comes after
    must stay out, and so must the tip.
    """
    lines = outline(model, q)
    found = [""] * len(q)
    for name, box in model.arm.keep_out.items():
        parts = box.crosses_segments(lines)
        below = np.logical_and.accumulate(box.holds(lines), axis=-1)
        parts &= ~below[:, :-1] | below[:, -1:]
        for k in np.flatnonzero(parts.any(axis=-1)):
            near = ", ".join(f"{number:.3g}" for number in lines[k, np.argmax(parts[k]) + 1])
            found[k] = found[k] or f"{name}: the arm would enter it near {near} m"
    return found
