"""Sightings of the tip at poses at which somebody else lets the arm rest."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from longarm_comp.core.data.rest import JOINT_REST, SETTLE_S
from longarm_comp.core.data.session import Session
from longarm_comp.jobs.client import ArmClient


def sightings_at_rest(
    client: ArmClient, poses: int, within_s: float, tell: Callable[[str], None]
) -> Session:
    """A row for every new pose at which the arm rests and the tip is seen."""
    span = client.arm.upper - client.arm.lower
    q: list[np.ndarray] = []
    xyz: list[np.ndarray] = []
    sd: list[np.ndarray] = []
    client.until(lambda: client.joints is not None, 30.0, "no joint_states")
    anchor, since = client.joints, time.monotonic()
    client.sightings.clear()

    def enough() -> bool:
        nonlocal anchor, since
        now = client.joints
        assert now is not None and anchor is not None
        if (np.abs(now - anchor) > JOINT_REST).any():
            anchor, since = now, time.monotonic()
            client.sightings.clear()
        if time.monotonic() - since < SETTLE_S:
            client.sightings.clear()  # what was taken before the arm hung still
            return False
        # Share of a joint's range by which one joint at least must differ from every pose
        # before
        if any((np.abs(now - old) <= 0.04 * span).all() for old in q):
            return False
        seen = [s for s in client.sightings if np.isfinite(s[1]).all()]
        if len(seen) >= 5:
            points = np.array([point for _, point, _ in seen])
            variance = np.mean([v for _, _, v in seen], axis=0) / len(seen)
            q.append(now)
            xyz.append(points.mean(axis=0))
            sd.append(np.sqrt(np.where(variance > 0, variance, np.nan)))
            tell(f"pose {len(q)} of {poses}: taken; move on")
        return len(q) >= poses

    client.until(
        enough, within_s,
        lambda: f"{len(q)} of {poses} poses within {within_s:g} s: let the arm rest at different "
        "poses where the marker is seen",
    )  # fmt: skip
    return Session.record(np.array(q), np.array(xyz), sigma=np.array(sd), source="live")
