"""Circular joints: removes jumps of a whole turn from a plan, as where an angle passes pi."""

import math

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.result import PathRefused, Status

_ROUNDING = 1e-6  # rad
_REMEDY = "allowed: at most half a turn from one way-point to the next"


def unwrap(arm: Arm, joints: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """Return planned joints (k, n) in which no angle jumps by a whole turn.

    The angle of a circular joint is at most half a turn from that at the way-point before.

    Args:
        joints: (k, n) planned joints, rad and m.
        start: (n,) joints before the first way-point; None: not known.

    Raises:
        PathRefused: the new angle lies outside the limits of the joint.
    """
    steps = _steps(joints, start)
    turns = np.where(arm.circular, -np.round(steps / math.tau), 0.0)
    made = joints + math.tau * np.cumsum(turns, axis=0)
    out = (made < arm.bounds[0] - _ROUNDING) | (made > arm.bounds[1] + _ROUNDING)
    if len(beyond := np.argwhere(out & (made != joints))):
        row, k = beyond[0]
        way = f"from {joints[row, k] - steps[row, k]:.4g} to {joints[row, k]:.4g} rad"
        limits = f"its limits, {arm.lower[k]:.4g} to {arm.upper[k]:.4g} rad"
        why = f"{way} is a turn back, as {made[row, k]:.4g} rad lies outside {limits}"
        raise PathRefused(Status.BAD_TARGET, int(row), f"{arm.joint_names[k]} {why}; {_REMEDY}")
    return made


def check_no_turn(arm: Arm, joints: np.ndarray) -> None:
    """Refuse solved joints (k, n) if a circular joint turns by more than half a turn in a step.

    Raises:
        PathRefused: names the way-point and the joint.
    """
    steps = np.where(arm.circular, _steps(joints, None), 0.0)
    if len(far := np.argwhere(np.abs(steps) > math.pi)):
        row, k = far[0]
        way = f"from {joints[row - 1, k]:.4g} to {joints[row, k]:.4g} rad"
        why = f"{way} is more than half a turn"
        raise PathRefused(Status.BAD_TARGET, int(row), f"{arm.joint_names[k]} {why}; {_REMEDY}")


def _steps(joints: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """Return the steps (k, n) from way-point to way-point; the first is from ``start``, or 0."""
    return np.diff(joints, axis=0, prepend=(joints[0] if start is None else start)[None])
