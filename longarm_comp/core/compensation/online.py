"""What is known of the running arm right now: its joints, and the circumstances of a target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import CLOCK, Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.unknown import NO_END
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.model.model import Model


class StaleContext(JobError):  # noqa: N818
    """A circumstance that the model needs was never told, or too long ago."""


class _Reading(NamedTuple):
    """What one source told last: columns as `Context` names them, and when (s, monotonic)."""

    columns: Mapping[str, float]
    at_s: float


@dataclass(frozen=True)
class Readings:
    """The last reading of every source (temperature, payload, inclination of a frame)."""

    readings: Mapping[str, _Reading] = field(default_factory=dict)

    def told(self, source: str, columns: Mapping[str, float], at_s: float) -> Readings:
        """With a new reading."""
        return replace(self, readings={**self.readings, source: _Reading(columns, at_s)})

    def fresh(self, source: str, now_s: float, max_age_s: float) -> Mapping[str, float]:
        """What a source told last; nothing where it is older than ``max_age_s``."""
        reading = self.readings.get(source)
        return reading.columns if reading and now_s - reading.at_s <= max_age_s else {}

    def context(
        self, model: Model, now_s: float, max_age_s: float, history: History | None = None
    ) -> Context:
        """The context of a target that is asked for now, with the history on arrival.

        A payload that was never told is the declared one. The latest word counts.

        Raises:
            StaleContext: an effect of the model, or the load, needs what is older than
                ``max_age_s`` or was never told.
        """
        columns: dict[str, float] = {}
        ages: dict[str, float] = {}
        for reading in sorted(self.readings.values(), key=lambda reading: reading.at_s):
            age = now_s - reading.at_s
            ages.update(dict.fromkeys(reading.columns, age))
            columns.update(reading.columns if age <= max_age_s else {})
        old = {name: age for name, age in ages.items() if age > max_age_s}
        told = Context(**({} if history is None else history.fields()), columns=columns)
        context = told.as_left(model.ended_s)
        if "payload_kg" in old and model.arm.payload is not None:
            raise _stale("payload_kg", old)
        for effect in model.effects:
            if name := effect.missing(context):
                raise _stale(name, old)
        return context


def _stale(column: str, old: Mapping[str, float]) -> StaleContext:
    if column == CLOCK:
        return StaleContext(NO_END)
    if column in old:
        return StaleContext(f"{column} is {old[column]:.1f} s old", column=column)
    return StaleContext(f"{column} was never published, and the model needs it", column=column)


_AGREEING = 3
"""Readings in a row that must agree before the joints are believed again."""


def check_inside(q: np.ndarray, arm: Arm, where: str) -> None:
    """Refuse joints (n,) outside the limits by more than 2 % of their range (rad, m)."""
    # Share of a joint's range by which a reading may lie outside its limits
    slack = 0.02 * (arm.upper - arm.lower)
    for k in np.flatnonzero(~((q >= arm.lower - slack) & (q <= arm.upper + slack))):
        allowed = f"{arm.lower[k]:g} to {arm.upper[k]:g}"
        raise InputError(where, arm.joint_names[k], float(q[k]), allowed)


class JointTrust:
    """Follows the readings of an arm's joints.

    After a jump (the numbers are wrong, or two arms publish in turn) they are doubtful until three
    readings in a row agree.  What moves faster than so many ranges per second (`rate`) is a jump.
    """

    def __init__(self, arm: Arm, rate: float) -> None:
        self._arm, self._rate = arm, rate
        self._last: tuple[np.ndarray, float] | None = None
        self._agreeing = _AGREEING
        self._why = ""

    @property
    def doubt(self) -> str:
        """Why the joints are not believed now; empty where they are."""
        return self._why if self._agreeing < _AGREEING else ""

    def read(self, q: np.ndarray, at_s: float) -> bool:
        """Take a reading (n,) of a time (s); whether the joints are believed after it."""
        before, self._last = self._last, (q, at_s)
        self._agreeing = min(self._agreeing + 1, _AGREEING)
        try:
            check_inside(q, self._arm, "joint_states")
        except InputError as error:
            self.distrust(str(error))
            self._last = before
            return False
        if before is not None:
            range_, dt = self._arm.upper - self._arm.lower, max(at_s - before[1], 0.0)
            share = np.abs(q - before[0]) / np.where(range_ > 0, range_, math.inf)
            k = int(np.argmax(share))
            # Share of a joint's range that two readings may differ by, however soon they follow
            if share[k] > 0.1 + self._rate * dt:
                name, was, now = self._arm.joint_names[k], before[0][k], q[k]
                self.distrust(
                    f"joint_states: {name} jumped from {was:.4g} to {now:.4g} within {dt:.3f} s; "
                    "does another node publish joint_states?"
                )
        return not self.doubt

    def distrust(self, why: str) -> None:
        """Doubt the joints until three readings agree."""
        self._agreeing, self._why = 0, why
