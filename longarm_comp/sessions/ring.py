"""Sightings of the tip while it rings: a CSV with t_s, x, y, z."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from longarm_comp.sessions.names import check_header
from longarm_comp.sessions.table import read_table


def read_ring(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) s and points (N, 3) m; rows without a sighting are left out."""
    table = read_table(path)
    check_header(table.where, table.header, ("t_s", *"xyz"))
    times = table.numbers("t_s", "s")
    xyz = np.stack([table.numbers(axis, "m", blanks=True) for axis in "xyz"], axis=-1)
    kept = np.isfinite(xyz).all(axis=1)
    return times[kept], xyz[kept]
