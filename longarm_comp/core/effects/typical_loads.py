"""Typical loads of an arm, in total and at each place; the priors of effects scale with them."""

import math
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm import spatial
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Chain, Posture
from longarm_comp.core.arm.spatial import Vec

_POSES = 64
"""Number of poses over which a typical load is averaged."""
_PAYLOAD = 0.3
"""Assumed payload over the arm's own weight: WAM and Panda have 0.15, iiwa and Gen3 0.5."""


class TypicalLoads(NamedTuple):
    """The size of an arm's loads."""

    force: float  # the arm's weight, N
    torque: float
    """The typical torque of the arm, N m: a quarter of weight times reach, or the RMS moment at the
    most loaded joint over random poses if it is less, because a heavy base loads no joint. It is
    always the quarter if the arm declares no weight, or if the place of a mass is recorded
    (`position_columns`)."""
    shares: tuple[float, ...]
    """By row, the moment for which the bearing of this row is built, over the largest of them: the
    RMS moment of the arm's own weight and of a payload (`_PAYLOAD`)."""

    def at(self, row: int) -> float:
        """Return the torque (N m) that the stiffness of the part at a row is assumed to scale with.

        It is the geometric mean of the arm's typical torque and that of the place: parts are as
        stiff as they are strong, but an arm has only few sizes of them. With it errors of real arms
        are smallest (`longarm study real`): WAM 2.15 mm (2.28 with the torque of the place alone).
        """
        return self.torque * math.sqrt(self.shares[max(row - 1, 0)])


_loads_of: dict[str, TypicalLoads] = {}


def typical_loads(arm: Arm) -> TypicalLoads:
    """Return the size of an arm's loads; an arm without declared weight has one kg per metre."""
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
        shares = np.maximum(built / max(built.max(), 1e-12), 0.01)  # no place is built for less
        loads = TypicalLoads(max(force, 1e-9), max(torque, 1e-9), tuple(shares.tolist()))
        _loads_of[arm.hash] = loads
    return _loads_of[arm.hash]


def _rms(vector: Vec) -> float:
    """Return the RMS length of a vector over the `_POSES` poses."""
    each = np.array([np.broadcast_to(part, _POSES) for part in vector])
    return math.sqrt((each**2).sum(axis=0).mean())


def reach(arm: Arm) -> float:
    """Return the sum of the rows' lengths and the tip's distance (m), slides at full travel."""
    total = 0.0
    for joint in arm.joints:
        if joint.pose is not None:
            total += float(np.linalg.norm(joint.pose.xyz_m))
        total += abs(joint.a_m) + abs(joint.d_m)
        if joint.type == "prismatic" and joint.commanded:
            total += max(abs(v) for v in joint.limits)
    return max(total + float(np.linalg.norm(arm.tip.position_m)), 1e-3)
