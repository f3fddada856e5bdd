"""The running arm as it is known now: its joints, and the circumstances of a target."""

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
    """The model needs a circumstance that was never received, or too long ago."""


class _Reading(NamedTuple):
    """The last reading of one source: columns as `Context` names them, and its time (s, monotonic).

    ``wrong``: why the arm cannot be in these circumstances; empty where it can.
    """

    columns: Mapping[str, float]
    at_s: float
    wrong: str = ""


@dataclass(frozen=True)
class Readings:
    """The last reading of every source (temperature, payload, inclination of a frame)."""

    readings: Mapping[str, _Reading] = field(default_factory=dict)

    def with_reading(
        self, source: str, columns: Mapping[str, float], at_s: float, wrong: str = ""
    ) -> Readings:
        """Add a reading.

        A ``wrong`` reading makes its columns unknown until another one comes.
        """
        return replace(self, readings={**self.readings, source: _Reading(columns, at_s, wrong)})

    def fresh(self, source: str, now_s: float, max_age_s: float) -> Mapping[str, float]:
        """Return a source's last reading; nothing if it is wrong or older than ``max_age_s``."""
        reading = self.readings.get(source)
        good = reading and not reading.wrong and now_s - reading.at_s <= max_age_s
        return reading.columns if reading and good else {}

    def context(
        self, model: Model, now_s: float, max_age_s: float, history: History | None = None
    ) -> Context:
        """Build the context of a target that is asked for now, with the history on arrival.

        Where several sources tell a column, the latest reading counts. A payload that was never
        received is the declared one.

        Raises:
            StaleContext: an effect of the model, or the load, needs a column that is older than
                ``max_age_s``, wrong, or was never received.
        """
        columns: dict[str, float] = {}
        doubts: dict[str, str] = {}
        wrong: dict[str, str] = {}
        for reading in sorted(self.readings.values(), key=lambda reading: reading.at_s):
            age = now_s - reading.at_s
            for name, value in reading.columns.items():
                old = f"{name} is {age:.1f} s old" if age > max_age_s else ""
                columns[name], doubts[name] = value, reading.wrong or old
                wrong[name] = reading.wrong
        known = {name: value for name, value in columns.items() if not doubts[name]}
        told = Context(**({} if history is None else history.fields()), columns=known)
        context = told.as_left(model.ended_s)
        # A payload that the arm cannot have weighs, whether or not arm.yaml says where it hangs
        weighed = doubts if model.arm.payload is not None else wrong
        if doubt := weighed.get("payload_kg"):
            raise StaleContext(doubt)
        for effect in model.effects:
            if name := effect.missing(context):
                never = f"{name} was never published, and the model needs it"
                raise StaleContext(NO_END if name == CLOCK else doubts.get(name) or never)
        return context


_AGREEING = 3
"""Readings in a row that must agree before the joints are believed again."""
_RESTART_S, _RIVALS_S = 1.0, 10.0
"""Another publisher of joints is doubted for so long; two that speak in turn, since they did last:
they may speak twice a second, or once in five."""


def check_inside(q: np.ndarray, arm: Arm, where: str) -> None:
    """Refuse joints (n,) outside the limits by more than 2 % of their range (rad, m)."""
    # Share of a joint's range by which a reading may lie outside its limits
    margin = 0.02 * (arm.upper - arm.lower)
    low, high = arm.bounds
    for k in np.flatnonzero(~((q >= low - margin) & (q <= high + margin))):
        allowed = f"{arm.lower[k]:g} to {arm.upper[k]:g}"
        raise InputError(where, arm.joint_names[k], float(q[k]), allowed)


class JointTrust:
    """The judge of the readings of an arm's joints: may they be believed?

    After a jump (the numbers are wrong, or two arms publish in turn) they are doubtful until three
    readings in a row agree.  A joint that moves by more ranges per second than `rate` has jumped.

    Every publisher numbers its messages upwards. A number that does not go up belongs to another
    publisher: once after a restart, again and again where two publish at the same time. Where the
    middleware gives no numbers, a jump counts as another publisher.
    """

    def __init__(self, arm: Arm, rate: float) -> None:
        self._arm, self._rate = arm, rate
        self._last: tuple[np.ndarray, float] | None = None
        self._agreeing = _AGREEING
        self._why = ""
        self._number, self._numbered = 0, True
        self._now_s, self._changed_s, self._until_s = 0.0, -math.inf, -math.inf

    @property
    def doubt(self) -> str:
        """The reason why the joints are not believed now; empty where they are."""
        return self._why if self._agreeing < _AGREEING else ""

    def heard(self, number: int | None, now_s: float) -> None:
        """Note that a message came now (s, monotonic), and its publisher's number of it."""
        self._now_s, self._numbered = now_s, number is not None
        if number is not None:
            if number <= self._number:
                self._change_publisher()
            self._number = number

    def read(self, q: np.ndarray, at_s: float) -> bool:
        """Take in a reading (n,) of a time (s); return whether the joints are believed after it."""
        before, self._last = self._last, (q, at_s)
        settled = self._now_s >= self._until_s
        self._agreeing = min(self._agreeing + 1, _AGREEING) if settled else 0
        try:
            check_inside(q, self._arm, "joint_states")
        except InputError as error:
            self.distrust(str(error))
            self._last = before
            return False
        if before is not None:
            range_, dt = self._arm.upper - self._arm.lower, max(at_s - before[1], 0.0)
            step = q - before[0]
            step -= np.where(np.isinf(self._arm.bounds[1]), math.tau * np.round(step / math.tau), 0)
            share = np.abs(step) / np.where(range_ > 0, range_, math.inf)
            k = int(np.argmax(share))
            # Share of a joint's range that two readings may differ by, however soon they follow
            if share[k] > 0.1 + self._rate * dt:
                name, was, now = self._arm.joint_names[k], before[0][k], q[k]
                self.distrust(
                    f"joint_states: {name} jumped from {was:.4g} to {now:.4g} within {dt:.3f} s; "
                    "does another node publish joint_states?"
                )
                if not self._numbered:
                    self._change_publisher()
        return not self.doubt

    def distrust(self, why: str) -> None:
        """Doubt the joints until three readings agree."""
        self._agreeing = 0
        if self._now_s >= self._until_s:
            self._why = why

    def _change_publisher(self) -> None:
        """Doubt the joints for a while, as they come from another publisher than before."""
        again = self._now_s - self._changed_s < _RIVALS_S
        rivals = "two publishers tell joint_states in turn: end one of them"
        self._agreeing, self._changed_s = 0, self._now_s
        self._why = rivals if again else "joint_states come from another publisher than before"
        self._until_s = self._now_s + (_RIVALS_S if again else _RESTART_S)
