"""Selects the sightings that show the arm at rest after a command, and averages them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from longarm_comp.core.data.rest import AFTER_S, JOINT_REST, REST_S, TIP_REST_M

NO_REST = f"the joints did not rest for {REST_S} s"
"""Why there is no position, where that is not the cameras' matter."""
_LAST = 5
"""Sightings whose median is the final position: two of them may be wrong."""


class Sighting(NamedTuple):
    """One measured tip at t (s): (3,) m and m^2, (4,) x, y, z, w and rad^2; NaN: not measured."""

    t: float
    xyz: np.ndarray
    variance: np.ndarray
    quaternion: np.ndarray
    turn_variance: float


def nowhere(t: float) -> Sighting:
    """A sighting at `t` (s) that measured nothing."""
    return Sighting(t, np.full(3, np.nan), np.zeros(3), np.full(4, np.nan), 0.0)


def settled(
    sightings: Sequence[Sighting], times: np.ndarray, joints: np.ndarray, begin: float
) -> tuple[Sighting | None, str]:
    """The mean of the settled sightings between a command at `begin` (s) and the next one.

    The arm is at rest once the measured joints stay at their final values (`JOINT_REST`) and the
    sightings at their final position (`TIP_REST_M` about the median of the last five).  Where there
    are sightings of the time after the joints stood still (`_still`), only these count: within
    `JOINT_REST` of its end a joint that still moves is millimetres off at the tip.

    Args:
        sightings: in the order of time.
        times, joints: (m,) s and (m, n) measured joints, rad and m; m may be 0.

    Returns:
        Mean time, position and orientation, and the variances of the mean; the position is NaN
        if the marker was lost in all of those at rest. None where no sighting came, or the arm only
        passed. And why there is no position; empty where there is one.
    """
    if not sightings:
        return None, "no sighting came"
    seen = [s for s in sightings if not np.isnan(s.xyz).any()]
    if not seen:
        return sightings[-1], "marker lost"
    if len(times):
        rest, arrived = _rest(times, joints, begin)
        if max(times[-1], sightings[-1].t) - rest < REST_S:
            return None, NO_REST
        still = _still(times, joints, rest)
        since = ([s for s in seen if s.t >= t] for t in (still + AFTER_S, still, arrived))
        seen = next(filter(None, since), [])
        if not seen:  # it was seen on the way only
            return nowhere(sightings[-1].t), "marker seen on the way only"
    last = np.median([s.xyz for s in seen[-_LAST:]], axis=0)
    kept: list[Sighting] = []
    for s in reversed(seen):
        if np.linalg.norm(s.xyz - last) <= TIP_REST_M:
            kept.append(s)
        elif len(kept) >= _LAST:
            break
    kept = kept or seen[-1:]
    n = len(kept)
    mean = Sighting(
        sum(s.t for s in kept) / n,
        np.mean([s.xyz for s in kept], axis=0),
        np.sum([s.variance for s in kept], axis=0) / n**2,
        _mean_turn([s.quaternion for s in kept]),
        sum(s.turn_variance for s in kept) / n**2,
    )
    return mean, ""


def still_since(times: np.ndarray, joints: np.ndarray, begin: float) -> float:
    """Time (s) from which on the joints stand after a command at `begin` (s), as in `settled`."""
    return _still(times, joints, _rest(times, joints, begin)[0])


def stood(times: np.ndarray, joints: np.ndarray, begin: float) -> np.ndarray:
    """(n,) mean of the measured joints at rest, as in `settled`; NaN: no rest."""
    rest = _rest(times, joints, begin)[0] if len(times) else begin
    if not len(times) or times[-1] - rest < REST_S:
        return np.full(joints.shape[1], np.nan)
    since = _still(times, joints, rest)
    return np.asarray(joints[times >= since].mean(axis=0))


def _rest(times: np.ndarray, joints: np.ndarray, begin: float) -> tuple[float, float]:
    """Times (s) of the last reading off the final joints, and of the first one at them."""
    moving = np.flatnonzero((np.abs(joints - joints[-1]) > JOINT_REST).any(axis=1))
    if not len(moving):
        return begin, begin
    return float(times[moving[-1]]), float(times[moving[-1] + 1])


def _still(times: np.ndarray, joints: np.ndarray, rest: float) -> float:
    """Time (s) from which on the measured joints change no more than in the last half of the rest.

    Encoders that flicker by a tick do so to the end.
    """
    last = joints[times >= min(times[-1] - REST_S, (rest + times[-1]) / 2)]
    low, high = last.min(axis=0), last.max(axis=0)
    flicker = high - low
    moving = ((joints < low - flicker) | (joints > high + flicker)).any(axis=1)
    return float(times[np.flatnonzero(moving)[-1] + 1] if moving.any() else times[0])


def _mean_turn(quaternions: Sequence[np.ndarray]) -> np.ndarray:
    """Mean of orientations that are close to each other; NaN where one is unknown."""
    if len(quaternions) == 1:
        return quaternions[0]
    alike = [q if q @ quaternions[0] >= 0 else -q for q in quaternions]
    total = np.sum(alike, axis=0)
    return np.asarray(total / np.linalg.norm(total))
