"""What a planner wants: way-points of the tip, and how it would have the joints go there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.model import Model

_POSE_JOINTS = 6
"""An arm of fewer joints cannot keep a planned orientation: its path is one of positions."""


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Way-points of the tip, base frame, and how a planner would have the joints bring it there.

    Attributes:
        targets: (k, 3) m or (k, 4, 4).
        times: (k,) s, increasing; None: as fast as the limits allow.
        joints: (k, n) as planned, to start each search from; None: none were planned.
        velocities: (k, n) as planned; None: none were.
        begun: the first way-point is where the planner believes the arm to stand.
    """

    targets: np.ndarray
    times: np.ndarray | None = None
    joints: np.ndarray | None = None
    velocities: np.ndarray | None = None
    begun: bool = False

    @classmethod
    def of_joints(
        cls, arm: Arm, times: np.ndarray, joints: np.ndarray, velocities: np.ndarray | None = None
    ) -> PlannedPath:
        """What a planner means with joints (k, n): the tip of the declared arm, rigid.

        The first way-point is where it believes the arm to stand.
        """
        poses = Model(arm).pose(joints)
        targets = poses if arm.n >= _POSE_JOINTS else poses[:, :3, 3]
        return cls(targets, times, joints, velocities, begun=True)

    def check(self, n: int) -> None:
        """Refuse shapes and times that are not allowed, of an arm of n joints."""
        k = len(self.targets)
        if not k or self.targets.shape[1:] not in ((3,), (4, 4)):
            allowed = "(k, 3) or (k, 4, 4), k of at least 1"
            raise InputError("path", "targets", f"shape {self.targets.shape}", allowed)
        for name in ("joints", "velocities"):
            given = getattr(self, name)
            if given is not None and (given.shape != (k, n) or not np.isfinite(given).all()):
                raise InputError("path", name, f"shape {given.shape}", f"({k}, {n}), finite")
        if self.times is None:
            return
        if self.times.shape != (k,) or not np.isfinite(self.times).all():
            raise InputError("path", "times", f"shape {self.times.shape}", f"({k},), finite")
        late = (np.diff(self.times, prepend=-np.inf) > 0.0) & (self.times >= 0.0)
        for row in np.flatnonzero(~late)[:1]:
            now = float(self.times[row])
            raise InputError("path", f"time of way-point {row}", now, "0 s or later, rising")


def as_planned(rigid: Model, model: Model, q: np.ndarray, context: Context) -> np.ndarray:
    """(n,) joints at which the declared, ``rigid`` arm has its tip where the model's is at q (n,).

    Where none inside the limits do, the nearest.
    """
    real = model.pose(q, context)
    target = real if model.arm.n >= _POSE_JOINTS else real[:3, 3]
    return ik.solve(rigid, target, seed=q, max_starts=1).q
