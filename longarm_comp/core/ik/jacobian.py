"""Jacobian of the tip by the joints: Eq. (5) with a unit twist at each joint's bearing."""

from __future__ import annotations

import math

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.arm.spatial import ZERO, Vec


def geometric(posture: Posture, tip: Vec, station: float = math.inf) -> list[tuple[Vec, Vec]]:
    """Tip velocity (m, base frame) and angular velocity (rad) per unit of each commanded joint.

    Of another point than the tip, ``station`` is the one that carries it: rows after it are left
    out.

    A revolute row turns all that follows about the z axis of its bearing; a prismatic row
    pushes it along the z axis of its frame.  Passive rows follow through the arm's mixing.
    The sag is kept constant, so on a soft arm the Jacobian is a few percent off.
    """
    chain = posture.chain
    columns: list[tuple[Vec, Vec]] = [(ZERO, ZERO)] * chain.arm.n
    for joint, row, weights in zip(chain.arm.joints, chain.rows, chain.mixing, strict=True):
        if joint.type == "fixed" or row.bearing > station:
            continue
        if joint.type == "revolute":
            bearing = posture.frames[row.bearing]
            lever = spatial.sub(tip, bearing.p)
            linear, angular = spatial.cross(bearing.a, lever), bearing.a
        else:
            linear, angular = posture.frames[row.frame].a, ZERO
        for k, weight in enumerate(weights):
            if weight != 0.0:
                w = float(weight)
                held = columns[k]
                columns[k] = (
                    spatial.add(held[0], spatial.scale(w, linear)),
                    spatial.add(held[1], spatial.scale(w, angular)),
                )
    return columns
