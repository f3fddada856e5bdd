"""The loads that an arm carries, in all and at each place: what priors of effects scale with."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Chain, Posture
from longarm_comp.core.arm.spatial import Vec

_POSES = 64
"""Poses over which a typical load is taken."""
_PAYLOAD = 0.3
"""Share of its weight that an arm is built to carry: WAM and Panda 0.15, iiwa and Gen3 0.5."""

_LEAST = 0.01
"""Of the largest moment: no place is built for less."""


class TypicalLoads(NamedTuple):
    """The size of an arm's loads.

    Attributes:
        force: its weight, N.
        torque: a quarter of weight times reach, or the RMS moment about the bearing that carries
            most, over poses between the limits, where that is less: a heavy base loads no joint.
            Where the place of a mass is recorded (`position_columns`), it is the quarter. N m.
        shares: of the moment that the most loaded place is built for, by what carries each row:
            RMS of the arm's own and of a payload (`_PAYLOAD`).
    """

    force: float
    torque: float
    shares: tuple[float, ...]

    def at(self, row: int) -> float:
        """Return the torque by which the stiffness of what carries a row goes, N m.

        It lies halfway, by ratio, between the arm's and that of the place: parts of a kind are as
        stiff as they are strong, and an arm has few kinds. Real arms (`longarm study real`) err
        least there: WAM 2.15 mm (2.28 by the place alone), iiwa 14 0.147 (0.156).
        """
        return self.torque * math.sqrt(self.shares[max(row - 1, 0)])


_loads_of: dict[str, TypicalLoads] = {}


def typical_loads(arm: Arm) -> TypicalLoads:
    """Return the size of an arm's loads; without a declared weight, of a kilogram a metre."""
    if arm.hash not in _loads_of:
        mass = sum(b.mass_kg for b in arm.links) + sum(m.mass_kg for m in arm.point_masses)
        mass += arm.payload.mass_kg if arm.payload else 0.0
        mass = mass if arm.declares_weight else reach(arm)
        force = mass * float(np.linalg.norm(arm.gravity_mps2))
        torque = force * reach(arm) / 4
        # The declared arm at poses between its limits
        poses = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_POSES, arm.n))
        chain, q = Chain(arm, elements_per_beam=1), tuple(np.ascontiguousarray(poses.T))
        posture = Posture(chain, q, Context(), *chain.place(q, {}), arm.gravity_mps2)
        tip, bearings = posture.frames[posture.spot()].p, [row.bearing for row in chain.rows]
        levers = [_rms(spatial.sub(tip, posture.frames[at].p)) for at in bearings]
        built = _PAYLOAD * force * np.array(levers)
        if arm.declares_weight and not any(m.position_columns for m in arm.point_masses):
            own = np.array([_rms(posture.moment(at)) for at in bearings])
            torque = min(torque, max(own[row - 1] for row in arm.commanded))
            built = built + own
        shares = np.maximum(built / max(built.max(), 1e-12), _LEAST)
        loads = TypicalLoads(max(force, 1e-9), max(torque, 1e-9), tuple(shares.tolist()))
        _loads_of[arm.hash] = loads
    return _loads_of[arm.hash]


def _rms(vector: Vec) -> float:
    """Return the RMS length of a vector over all poses."""
    each = np.array([np.broadcast_to(part, _POSES) for part in vector])
    return math.sqrt((each**2).sum(axis=0).mean())


def reach(arm: Arm) -> float:
    """Sum of the rows' lengths (m), with each slide at full travel and the tip's distance added."""
    total = 0.0
    for joint in arm.joints:
        if joint.pose is not None:
            total += float(np.linalg.norm(joint.pose.xyz_m))
        total += abs(joint.a_m) + abs(joint.d_m)
        if joint.type == "prismatic" and joint.commanded:
            total += max(abs(v) for v in joint.limits)
    return max(total + float(np.linalg.norm(arm.tip.position_m)), 1e-3)
