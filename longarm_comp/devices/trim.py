"""Trim: corrects the goals of a resting arm, in a few bounded steps, by its remaining error.

A servo with proportional control stops short of its goal under load.  Each step moves the goal by
the error that is left; friction may absorb a step without a motion, so there are several.  The
corrections found are the start of the next move.  Where a large error is left after the steps, as
with an encoder that is frozen or has slipped, that joint's correction is undone and reported.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from longarm_comp.devices.joint_path import Array
from longarm_comp.devices.servo_bus.state import ServoState
from longarm_comp.devices.servo_config import ServoConfig

MOST_STEPS = 5
"""Steps after a move: two of them find a droop, the others are for friction."""


class Trim:
    """Corrections of the goals, in ticks, in the order of the configuration.

    Args:
        config: the joints, and the largest correction.

    Attributes:
        offset: (n,) corrections that are wanted.
    """

    def __init__(self, config: ServoConfig) -> None:
        self._joints = config.joints
        self._most = config.follower.trim_ticks
        self._held = config.follower.stall_error_ticks / MOST_STEPS
        self._rate = np.array([j.max_speed_ticks_s for j in config.joints.values()])
        self.drop()

    def drop(self) -> None:
        """Make no correction any more."""
        self.offset = np.zeros(len(self._joints))
        self._applied = self.offset.copy()
        self._steps = 0

    def begin(self, path: bool) -> None:
        """Begin a move with the last corrections; a path has none."""
        self._steps = 0
        if path:
            self.offset = np.zeros(len(self._joints))

    def correction_now(self, dt: float) -> Array:
        """Return the (n,) corrections after `dt` (s); they change no faster than joints may."""
        step = np.clip(self.offset - self._applied, -self._rate * dt, self._rate * dt)
        self._applied = self._applied + step
        return self._applied

    def take_step(self, wanted: Mapping[str, int], states: Mapping[str, ServoState]) -> bool:
        """Take another step from the readings of a resting arm; whether there was one to take.

        Args:
            wanted: goal without correction by joint, ticks.
            states: trusted read-back by joint.
        """
        missing = np.array([wanted[name] - states[name].position_ticks for name in self._joints])
        if not missing.any() or self._steps == MOST_STEPS:
            return False
        self._steps += 1
        before = self.offset
        self.offset = np.clip(before + missing, -self._most, self._most)
        for k, (name, joint) in enumerate(self._joints.items()):
            low, high = joint.tick_limits
            self.offset[k] = np.clip(self.offset[k], low - wanted[name], high - wanted[name])
            if abs(states[name].load) >= joint.max_load:
                self.offset[k] = before[k]
        return bool((self.offset != before).any())

    def describe_failure(self, wanted: Mapping[str, int], states: Mapping[str, ServoState]) -> str:
        """Say which joints no step brought near, and how far off they are; those lose theirs.

        What friction holds is off by so little that all steps together are no stall.  One that
        would have to go beyond its limit is as near as it may be.
        """
        said = []
        for k, (name, joint) in enumerate(self._joints.items()):
            off = (states[name].position_ticks - wanted[name]) * joint.si_per_tick
            free = joint.tick_limits[0] < wanted[name] + self.offset[k] < joint.tick_limits[1]
            if free and abs(off) > self._held * joint.si_per_tick:
                by = abs(self.offset[k]) * joint.si_per_tick
                said.append(
                    f"{name} by {abs(off):.4g} {joint.unit} after {by:.4g} {joint.unit} of trim"
                )
                self.offset[k] = 0.0
        return ", ".join(said)
