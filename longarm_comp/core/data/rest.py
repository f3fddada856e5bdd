"""When the arm is at rest; finds rest poses in a stream of commands, readings and sightings.

Sightings of one pose share the pose's model error, so only their mean is an independent sample.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from longarm_comp.core.arm.history import History
from longarm_comp.core.errors import InputError

JOINT_REST = 2e-3
"""Largest distance (rad, m) of a resting joint from its goal or its final position: a tick of
its encoder, and what its controller leaves."""
SETTLE_S = 0.5
"""Time (s) for which the joints have rested before a sighting counts: the arm swings no more."""
TIP_REST_M = 3e-3
"""Largest distance (m) of a settled sighting from the final position of the sightings."""
REST_S = 0.1
"""Shortest rest (s) of the measured joints; a shorter one is only a passage."""
AFTER_S = 0.05
"""The tip comes to rest this long (s) after the last change of the measured joints, at most."""


@dataclass(frozen=True)
class RestPose:
    """The arm at rest at a commanded pose, and the mean sighting of the tip.

    Attributes:
        q, history: (n,) commanded joints, rad and m, and how they came there.
        tip, variance: (3,) m; (3,) m^2 of the mean, from the variances of the sightings.
        command: number of the command, counted from 1.
    """

    q: np.ndarray
    history: History
    tip: np.ndarray
    variance: np.ndarray
    command: int


@dataclass
class RestWatch:
    """Returns each rest pose once: the mean of `sightings` once joints rested for `settle_s`."""

    settle_s: float = SETTLE_S
    sightings: int = 3
    commands: int = 0
    _goal: tuple[np.ndarray, History] | None = None
    _there_since: float | None = None
    _told: bool = False
    _seen: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.sightings < 1:
            raise InputError("rest watch", "sightings", self.sightings, "1 or more")

    def commanded(self, q: np.ndarray, history: History) -> None:
        """Take a command q (n,) and the history of the joints on arrival."""
        self._goal, self._there_since, self._told = (q, history), None, False
        self._seen.clear()
        self.commands += 1

    def reached(self) -> None:
        """The driver says that the joints rest where they were sent, however far they give way."""
        self._told = True

    def joints(self, q: np.ndarray, at_s: float) -> None:
        """Take a joint reading q (n,) of a time (s, of the clock of the sightings)."""
        if self._goal is None:
            return
        if not self._told and np.abs(q - self._goal[0]).max() > JOINT_REST:
            self._there_since = None
            self._seen.clear()
        elif self._there_since is None or at_s < self._there_since:  # a clock that jumped back
            self._there_since = at_s

    def sighted(self, tip: np.ndarray, variance: np.ndarray, at_s: float) -> RestPose | None:
        """Take a sighting (m, m^2; NaN if lost) of a time (s); the rest pose that it completes.

        The time is that of the images: a sighting that comes late shows the arm as it was then.
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
        return RestPose(q, history, mean, scatter / len(tips), self.commands)
