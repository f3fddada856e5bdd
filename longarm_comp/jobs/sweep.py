"""Sweep: every joint between its limits once, so that the history of the joints is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.moves import sweep
from longarm_comp.core.errors import InputError
from longarm_comp.jobs.client import ArmClient, Pace
from longarm_comp.jobs.graph_client import Interrupted

SLOWEST_S, FASTEST_S = 3600.0, 0.1
"""Allowed times for a joint's whole range."""


def way_times(arm: Arm, start: np.ndarray, path: np.ndarray, range_s: float) -> np.ndarray:
    """(k,) s for each way of a path (k, n), so that no joint covers its range in less time."""
    if not FASTEST_S <= range_s <= SLOWEST_S:
        raise InputError("sweep", "--seconds", range_s, f"{FASTEST_S:g} to {SLOWEST_S:g}")
    ways = np.abs(np.diff(np.vstack([start, path]), axis=0))
    return range_s * (ways / (arm.upper - arm.lower)).max(axis=1)


def sweep_joints(
    client: ArmClient,
    *,
    range_s: float,
    margin: float = 0.02,
    together: bool = True,
    agree: Callable[[np.ndarray, float], None] = lambda path, seconds: None,
    pace: Pace | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> int:
    """Drive the sweep from where the joints stand and back; the number of moves made.

    Args:
        range_s: least time (s) for the whole range of any joint; the driver may be slower.
        margin: kept from every limit, as a share of the joint's range.
        together: all joints at once; else one after another.
        agree: called with the way-points (k, n) and their time (s) before anything moves; it
            raises where they are not to be driven.
    """
    pace = pace or Pace()
    client.ready(tip=False)
    start = np.array(client.joints)
    path = sweep(client.arm, start, margin, together=together)
    times = way_times(client.arm, start, path, range_s)
    agree(path, float(times.sum()))
    try:
        for k, (point, seconds) in enumerate(zip(path, times.tolist(), strict=True)):
            progress(f"move {k + 1} of {len(path)}", k / len(path))
            client.send(point[None], max(seconds, pace.move_s))
            client.spin(0.05)
            client.arrive(point[None], pace, more_s=seconds)
    except Interrupted:
        if client.joints is not None:
            client.send(client.joints[None], pace.move_s)
        raise
    return len(path)
