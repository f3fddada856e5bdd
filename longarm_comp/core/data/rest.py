"""Finds when the arm rests: in a live stream (`RestWatch`) or in a recording (`mean_at_rest`).

Sightings of one pose share the pose's model error, so only their mean is an independent sample.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.history import History
from longarm_comp.core.errors import InputError

JOINT_REST = 2e-3
"""Largest distance (rad, m) of a resting joint from its goal or its final position.

It covers an encoder tick and the error that a controller leaves.
"""
TIP_REST_M = 3e-3
"""Largest distance (m) of a settled sighting from the final position of the sightings."""
REST_S = 0.1
"""Shortest rest (s) of the measured joints; if they stay for less, they only passed."""
AFTER_S = 0.05
"""Longest time (s) from the last change of the measured joints until the tip rests."""


@dataclass(frozen=True)
class RestPose:
    """The arm at rest at a commanded pose, and the mean sighting of the tip."""

    q: np.ndarray  # (n,) commanded joints, rad and m
    history: History  # of the joints on arrival
    tip: np.ndarray  # (3,) mean of the sightings, m
    variance: np.ndarray
    """(3,) variance of this mean, m^2, computed from the variances of the sightings."""


@dataclass
class RestWatch:
    """Finds rest poses in a stream; each command gives at most one."""

    settle_s: float = 0.5  # how long the joints must rest before a sighting counts
    sightings: int = 3  # number that is averaged
    _goal: tuple[np.ndarray, History] | None = None
    _there_since: float | None = None
    _arrived_s: float = math.inf
    _stands: np.ndarray | None = None  # the first joint reading after the driver reported arrival
    _seen: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.sightings < 1:
            raise InputError("rest watch", "sightings", self.sightings, "1 or more")

    def on_command(self, q: np.ndarray, history: History) -> None:
        """Register a command q (n,), rad and m, and the history of the joints on arrival."""
        self._goal, self._there_since = (q, history), None
        self._arrived_s, self._stands = math.inf, None
        self._seen.clear()

    def forget(self) -> None:
        """Forget the command: the arm does not go there any more, or has left it."""
        self._goal = None

    def on_arrival(self, at_s: float) -> None:
        """Register that the driver reported arrival: the joints rest from the time `at_s` (s) on.

        From then on the joints may be off their goal. But if they move by more than `JOINT_REST`,
        the command is forgotten, because something else moved them. Readings from before that
        time may still come.
        """
        self._arrived_s = at_s

    def joints(self, q: np.ndarray, at_s: float) -> None:
        """Register a joint reading q (n,), rad and m, at a time (s, on the sightings' clock)."""
        if self._goal is None:
            return
        if at_s >= self._arrived_s:
            self._stands = q if self._stands is None else self._stands
            if np.abs(q - self._stands).max() > JOINT_REST:
                self.forget()
                return
        if at_s < self._arrived_s and np.abs(q - self._goal[0]).max() > JOINT_REST:
            self._there_since = None
            self._seen.clear()
        elif self._there_since is None or at_s < self._there_since:  # a clock that jumped back
            self._there_since = at_s

    def on_sighting(self, tip: np.ndarray, variance: np.ndarray, at_s: float) -> RestPose | None:
        """Register a sighting, and return the rest pose if this sighting completes it.

        Args:
            tip: (3,) m; NaN if the marker was lost.
            variance: (3,) m^2.
            at_s: time of the images, s, which may be before this call.
        """
        settled = self._there_since is not None and at_s - self._there_since >= self.settle_s
        if self._goal is None or not settled or not np.isfinite(tip).all():
            return None
        self._seen.append((tip, variance))
        if len(self._seen) < self.sightings:
            return None
        (q, history), self._goal = self._goal, None
        tips, variances = (np.array(part) for part in zip(*self._seen, strict=True))
        mean, scatter = tips.mean(axis=0), np.maximum(variances, 0.0).mean(axis=0)
        return RestPose(q, history, mean, scatter / len(tips))


NO_REST = f"the joints did not rest for {REST_S} s"
"""The reason why there is no position, if the joints and not the cameras caused it."""
_LAST = 5
"""Number of last sightings whose median is the final position; two of them may be wrong."""


def is_of_two_arms(joints: np.ndarray) -> bool:
    """Tell whether (m, n) joint readings, rad and m, alternate between those of two arms.

    At least 4 steps between readings are far above encoder noise, and the next step reverses more
    than two thirds of them (half of them for a swinging arm, read four times a period).
    Differences by whole turns of a joint are ignored.
    """
    steps = np.diff(joints, axis=0)
    steps -= np.round(steps / (2 * np.pi)) * 2 * np.pi
    leaps = steps[np.abs(steps).max(axis=1, initial=0.0) > 10 * JOINT_REST]
    back = np.abs(leaps[1:] + leaps[:-1]).max(axis=1, initial=0.0)
    returned = back < 0.3 * np.abs(leaps[1:]).max(axis=1, initial=0.0)
    return bool(len(leaps) >= 4 and returned.mean() > 2 / 3)


class Sighting(NamedTuple):
    """A measured tip; NaN where something was not measured."""

    t: float  # s
    xyz: np.ndarray  # (3,) position, m
    variance: np.ndarray  # (3,) of the position, m^2; NaN where it is not known
    quaternion: np.ndarray  # (4,) orientation x, y, z, w
    turn_variance: float  # of the orientation, rad^2


def blank_sighting(t: float) -> Sighting:
    """Return a sighting at `t` (s) without a measurement."""
    return Sighting(t, np.full(3, np.nan), np.full(3, np.nan), np.full(4, np.nan), 0.0)


def mean_at_rest(
    sightings: Sequence[Sighting], times: np.ndarray, joints: np.ndarray, begin: float
) -> tuple[Sighting | None, str]:
    """Return the mean of the sightings at rest between a command and the next one.

    The arm is at rest once the measured joints stay at their final values (`JOINT_REST`) and the
    sightings at their final position (`TIP_REST_M` about the median of the last five).  Sightings
    after the joints stopped completely (`_still_from`) are preferred, because a joint that still
    moves within `JOINT_REST` of its end displaces the tip by millimetres.

    Args:
        sightings: those between the two commands, in the order of time.
        times: (m,) times of the joint readings, s; m may be 0.
        joints: (m, n) measured joints, rad and m.
        begin: time of the command, s.

    Returns:
        First the mean sighting, with the variances of the mean. Its position is NaN if the marker
        was not seen at rest. It is None if there was no sighting, or the joints did not rest.
        Second the reason why there is no position; empty if there is one.
    """
    if not sightings:
        return None, "no sighting came"
    seen = [s for s in sightings if not np.isnan(s.xyz).any()]
    if not seen:
        return sightings[-1], "marker lost"
    if len(times):
        rest, arrived = _end_of_motion(times, joints, begin)
        if max(times[-1], sightings[-1].t) - rest < REST_S:
            return None, NO_REST
        still = _still_from(times, joints, rest)
        since = ([s for s in seen if s.t >= t] for t in (still + AFTER_S, still, arrived))
        seen = next(filter(None, since), [])
        if not seen:  # it was seen during the motion only
            return blank_sighting(sightings[-1].t), "marker seen on the way only"
    last = np.median([s.xyz for s in seen[-_LAST:]], axis=0)
    kept: list[Sighting] = []
    for s in reversed(seen):
        if np.linalg.norm(s.xyz - last) <= TIP_REST_M:
            kept.append(s)
        elif len(kept) >= _LAST:
            break
    kept = kept or seen[-1:]
    n = len(kept)
    turn = kept[0].quaternion  # the others are close to it; NaN where one is unknown
    if n > 1:
        same = [s.quaternion if s.quaternion @ turn >= 0 else -s.quaternion for s in kept]
        turn = np.sum(same, axis=0) / np.linalg.norm(np.sum(same, axis=0))
    mean = Sighting(
        sum(s.t for s in kept) / n,
        np.mean([s.xyz for s in kept], axis=0),
        np.sum([s.variance for s in kept], axis=0) / n**2,
        turn,
        sum(s.turn_variance for s in kept) / n**2,
    )
    return mean, ""


def still_since(times: np.ndarray, joints: np.ndarray, begin: float) -> float:
    """Return the time (s) from which on the joints stand still after a command at `begin` (s)."""
    return _still_from(times, joints, _end_of_motion(times, joints, begin)[0])


def joints_at_rest(times: np.ndarray, joints: np.ndarray, begin: float) -> np.ndarray:
    """Return the (n,) mean of the joints at rest (`mean_at_rest`); NaN if they did not rest."""
    rest = _end_of_motion(times, joints, begin)[0] if len(times) else begin
    if not len(times) or times[-1] - rest < REST_S:
        return np.full(joints.shape[1], np.nan)
    return np.asarray(joints[times >= _still_from(times, joints, rest)].mean(axis=0))


def _end_of_motion(times: np.ndarray, joints: np.ndarray, begin: float) -> tuple[float, float]:
    """Return the times (s) of the last reading away from the final joints, and of the next one."""
    moving = np.flatnonzero((np.abs(joints - joints[-1]) > JOINT_REST).any(axis=1))
    if not len(moving):
        return begin, begin
    return float(times[moving[-1]]), float(times[moving[-1] + 1])


def _still_from(times: np.ndarray, joints: np.ndarray, rest: float) -> float:
    """Return the time (s) from which on the joints only flicker, as in the last half of the rest.

    The flicker is that of encoders, by one tick.  `rest` is as returned by `_end_of_motion`.
    """
    last = joints[times >= min(times[-1] - REST_S, (rest + times[-1]) / 2)]
    low, high = last.min(axis=0), last.max(axis=0)
    flicker = high - low
    moving = ((joints < low - flicker) | (joints > high + flicker)).any(axis=1)
    return float(times[np.flatnonzero(moving)[-1] + 1] if moving.any() else times[0])
