"""Targets along a smooth path through the joint box, as in normal operation."""

from __future__ import annotations

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import declared_model

_REACH = 0.15  # of each joint's range, to either side of its middle
_STEP = 0.05  # rad of phase from one target to the next


def slow_path(arm: Arm, count: int) -> np.ndarray:
    """(count, 4, 4) reachable poses of the declared arm along a smooth path."""
    phase = _STEP * np.arange(count)[:, None] * (1.0 + 0.1 * np.arange(arm.n)) + np.arange(arm.n)
    return declared_model(arm).pose(arm.mid + _REACH * (arm.upper - arm.lower) * np.sin(phase))
