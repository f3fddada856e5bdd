"""A ring after a move: a CSV with t_s and the tip's x, y, z, or joint readings read_q1..qn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.sessions.names import check_header
from longarm_comp.sessions.table import read_table


@dataclass(frozen=True, eq=False)
class RecordedRing:
    """What was seen at times (N,) s: the tip (N, 3) m, or the joints (N, n) rad and m."""

    times: np.ndarray
    seen: np.ndarray
    of_joints: bool


def read_ring(path: str | Path, arm: Arm) -> RecordedRing:
    """Read it; rows with a blank are left out."""
    table = read_table(path)
    readings = [f"read_q{joint}" for joint in range(1, arm.n + 1)]
    of_joints = bool(set(readings) & set(table.header))
    names = readings if of_joints else list("xyz")
    check_header(table.where, table.header, ("t_s", *names))
    times = table.numbers("t_s", "s")
    unit = "rad or m" if of_joints else "m"
    seen = np.stack([table.numbers(name, unit, blanks=True) for name in names], axis=-1)
    kept = np.isfinite(seen).all(axis=1)
    return RecordedRing(times[kept], seen[kept], of_joints)
