"""One measured residual per rest pose, out of a running stream of commands, joints and sightings.

Sightings of one pose share the pose's model error, so only their mean is an independent sample.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from longarm_comp.core.arm.history import History
from longarm_comp.core.errors import InputError

JOINT_REST = 2e-3
"""Joints (rad, m) this close to where they were sent, or to where they end, rest there."""


@dataclass(frozen=True)
class RestPose:
    """The arm at rest where it was sent, and the mean of what was seen.

    Attributes:
        q: (n,) commanded joints, rad and m. history: how they came there.
        tip: (3,) m. variance: (3,) m^2, of the mean as the sightings claim.
        command: number of the command, counted from 1.
    """

    q: np.ndarray
    history: History
    tip: np.ndarray
    variance: np.ndarray
    command: int


@dataclass
class RestWatch:
    """Hands out each rest pose once.

    Args:
        settle_s: the joints must have been there for so long.
        sightings: averaged for one rest pose.
    """

    settle_s: float = 0.5
    sightings: int = 3
    commands: int = 0
    _goal: tuple[np.ndarray, History] | None = None
    _there_since: float | None = None
    _seen: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.sightings < 1:
            raise InputError("rest watch", "sightings", self.sightings, "1 or more")

    def commanded(self, q: np.ndarray, history: History) -> None:
        """The arm is sent to q (n,); `history`: of the joints when they are there."""
        self._goal, self._there_since = (q, history), None
        self._seen.clear()
        self.commands += 1

    def joints(self, q: np.ndarray, at_s: float) -> None:
        """The joints are at q (n,)."""
        if self._goal is None:
            return
        if np.abs(q - self._goal[0]).max() > JOINT_REST:
            self._there_since = None
            self._seen.clear()
        elif self._there_since is None:
            self._there_since = at_s

    def sighted(self, tip: np.ndarray, variance: np.ndarray, at_s: float) -> RestPose | None:
        """The tip was seen (m, m^2; NaN: lost); the rest pose once it is known well enough."""
        settled = self._there_since is not None and at_s - self._there_since >= self.settle_s
        if self._goal is None or not settled or not np.isfinite(tip).all():
            return None
        self._seen.append((tip, variance))
        if len(self._seen) < self.sightings:
            return None
        (q, history), self._goal = self._goal, None
        tips, variances = (np.array(part) for part in zip(*self._seen, strict=True))
        mean, scatter = tips.mean(axis=0), np.maximum(variances, 0.0).mean(axis=0)
        return RestPose(q, history, mean, scatter / len(tips), self.commands)
