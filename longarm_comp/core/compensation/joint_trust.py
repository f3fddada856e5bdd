"""Whether readings of joints may be believed: inside the limits, and no faster than joints go."""

from __future__ import annotations

import math

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError

_AGREEING = 3
"""Readings in a row that must agree before the joints are believed again."""


def check_inside(q: np.ndarray, arm: Arm, where: str) -> None:
    """Refuse joints (n,) outside the limits by more than 2 % of their range (rad, m)."""
    # Share of a joint's range by which a reading may lie outside its limits
    slack = 0.02 * (arm.upper - arm.lower)
    for k in np.flatnonzero(~((q >= arm.lower - slack) & (q <= arm.upper + slack))):
        allowed = f"{arm.lower[k]:g} to {arm.upper[k]:g}"
        raise InputError(where, arm.joint_names[k], float(q[k]), allowed)


class JointTrust:
    """Follows the readings of an arm's joints.

    After a jump (the numbers are wrong, or two arms publish in turn) they are doubtful until three
    readings in a row agree.  What moves faster than so many ranges per second (`rate`) is a jump.
    """

    def __init__(self, arm: Arm, rate: float) -> None:
        self._arm, self._rate = arm, rate
        self._last: tuple[np.ndarray, float] | None = None
        self._agreeing = _AGREEING
        self._why = ""

    @property
    def doubt(self) -> str:
        """Why the joints are not believed now; empty where they are."""
        return self._why if self._agreeing < _AGREEING else ""

    def read(self, q: np.ndarray, at_s: float) -> bool:
        """Take a reading (n,) of a time (s); whether the joints are believed after it."""
        before, self._last = self._last, (q, at_s)
        self._agreeing = min(self._agreeing + 1, _AGREEING)
        try:
            check_inside(q, self._arm, "joint_states")
        except InputError as error:
            self.distrust(str(error))
            self._last = before
            return False
        if before is not None:
            range_, dt = self._arm.upper - self._arm.lower, max(at_s - before[1], 0.0)
            share = np.abs(q - before[0]) / np.where(range_ > 0, range_, math.inf)
            k = int(np.argmax(share))
            # Share of a joint's range that two readings may differ by, however soon they follow
            if share[k] > 0.1 + self._rate * dt:
                name, was, now = self._arm.joint_names[k], before[0][k], q[k]
                self.distrust(
                    f"joint_states: {name} jumped from {was:.4g} to {now:.4g} within {dt:.3f} s; "
                    "does another node publish joint_states?"
                )
        return not self.doubt

    def distrust(self, why: str) -> None:
        """Doubt the joints until three readings agree."""
        self._agreeing, self._why = 0, why
