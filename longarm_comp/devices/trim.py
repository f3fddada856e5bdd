"""Trim: corrects the goals of a resting arm, in a few bounded steps, by the error that remains.

A servo with proportional control stops short of its goal under load.  Each step moves the goal by
the remaining error.  Friction may absorb a step without a motion, so there are several.  The next
move starts with the corrections found.  If a large error remains after all steps, as with an
encoder that is frozen or has slipped, this joint's correction is undone and reported.
"""

from collections.abc import Mapping

import numpy as np

from longarm_comp.devices.joint_path import Array
from longarm_comp.devices.servo_bus.state import ServoState
from longarm_comp.devices.servo_config import ServoConfig

MOST_STEPS = 5
"""Largest number of steps after a move. Two of them correct a droop, the others are for friction.
"""


class Trim:
    """Corrections of the goals, in ticks, in the order of the configuration.

    Args:
        config: configuration of the joints, and the largest correction.

    Attributes:
        offset: (n,) corrections to be reached, ticks.
    """

    def __init__(self, config: ServoConfig) -> None:
        self._joints = config.joints
        self._most = config.follower.trim_ticks
        self._held = config.follower.stall_error_ticks / MOST_STEPS
        self._rate = np.array([j.max_speed_ticks_s for j in config.joints.values()])
        self.drop()

    def drop(self) -> None:
        """Set all corrections to 0 at once."""
        self.offset = np.zeros(len(self._joints))
        self._applied = self.offset.copy()
        self._steps = 0

    def begin(self, path: bool) -> None:
        """Begin a motion: a move keeps the last corrections, a ``path`` returns to none."""
        self._steps = 0
        if path:
            self.offset = np.zeros(len(self._joints))

    def correction_now(self, dt: float) -> Array:
        """Return the corrections (n,), ticks, after a step of `dt`, s.

        They approach `offset` no faster than the joints may move.
        """
        step = np.clip(self.offset - self._applied, -self._rate * dt, self._rate * dt)
        self._applied = self._applied + step
        return self._applied

    def take_step(self, wanted: Mapping[str, int], states: Mapping[str, ServoState]) -> bool:
        """Correct `offset` by the readings of a resting arm; return whether it has changed.

        Args:
            wanted: goal without correction, ticks, by joint.
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
        """Say which joints are still too far off after all steps, and undo their corrections.

        An error that friction can hold is allowed: up to a fifth of `stall_error_ticks`.  A joint
        whose corrected goal is at its limit does not count, because it can come no nearer.
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
