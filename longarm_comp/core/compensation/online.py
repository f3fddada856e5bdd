"""Decides which readings of the running arm are believed, and which circumstances hold."""

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
    """The model needs a circumstance that is missing, too old or wrong."""


class _Reading(NamedTuple):
    """The last reading of one source."""

    columns: Mapping[str, float]  # values by the column names of `Context`
    at_s: float  # time of the reading, s, monotonic clock
    wrong: str = ""  # why the arm cannot be in these circumstances; empty if it can


@dataclass(frozen=True)
class Readings:
    """The last reading of every source (temperature, payload, inclination of a frame)."""

    readings: Mapping[str, _Reading] = field(default_factory=dict)

    def with_reading(
        self, source: str, columns: Mapping[str, float], at_s: float, wrong: str = ""
    ) -> Readings:
        """Return the readings with a new one of a source, which replaces that source's last one.

        Args:
            source: name of the source.
            columns, at_s: as in `_Reading`.
            wrong: why the reading cannot be true. Its columns are then unknown until the next one.
        """
        return replace(self, readings={**self.readings, source: _Reading(columns, at_s, wrong)})

    def fresh(self, source: str, now_s: float, max_age_s: float) -> Mapping[str, float]:
        """Return the columns of a source's last reading; {} if missing, wrong or too old.

        Args:
            now_s: the present time, s, monotonic clock.
            max_age_s: largest age of the reading, s.
        """
        reading = self.readings.get(source)
        good = reading and not reading.wrong and now_s - reading.at_s <= max_age_s
        return reading.columns if reading and good else {}

    def context(
        self, model: Model, now_s: float, max_age_s: float, history: History | None = None
    ) -> Context:
        """Build the circumstances of a target that is requested now.

        If several sources give a column, the latest reading counts. A payload that was never
        received is the declared one.

        Args:
            now_s: the present time, s, monotonic clock.
            max_age_s: largest age of a reading, s.
            history: history of the joints on arrival at the target.

        Raises:
            StaleContext: an effect of the model needs a column that was never received, is wrong or
                older than ``max_age_s``; or the payload is wrong, or too old if arm.yaml has one.
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
        # An impossible payload is refused even if arm.yaml does not say where a payload hangs
        weighed = doubts if model.arm.payload is not None else wrong
        if doubt := weighed.get("payload_kg"):
            raise StaleContext(doubt)
        for effect in model.effects:
            if name := effect.missing(context):
                never = f"{name} was never published, and the model needs it"
                raise StaleContext(NO_END if name == CLOCK else doubts.get(name) or never)
        return context


_AGREEING = 3
"""Number of readings in a row that must agree before the joints are believed again."""
_RESTART_S, _RIVALS_S = 1.0, 10.0
"""How long the joints are doubted after a change of the publisher, s: the first value after one
change, the second if it is less than `_RIVALS_S` after the last change (two publishers in turn)."""


def check_inside(q: np.ndarray, arm: Arm, where: str) -> None:
    """Raise InputError if a joint of (n,) is outside its limits by over 2 % of its range."""
    # Share of a joint's range by which a reading may lie outside its limits
    margin = 0.02 * (arm.upper - arm.lower)
    low, high = arm.bounds
    for k in np.flatnonzero(~((q >= low - margin) & (q <= high + margin))):
        allowed = f"{arm.lower[k]:g} to {arm.upper[k]:g}"
        raise InputError(where, arm.joint_names[k], float(q[k]), allowed)


class JointTrust:
    """Judges whether the readings of an arm's joints may be believed.

    After a jump (wrong values, or two arms that publish in turn) they are doubted until three
    readings in a row agree.  A step counts as a jump if it is more than a tenth of the joint's
    range plus `rate` ranges per second.

    Every publisher numbers its messages upwards. A number that does not rise belongs to another
    publisher: this happens once after a restart, and again and again if two publish at the same
    time. If the middleware gives no numbers, a jump counts as a change of the publisher.
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
        """The reason why the joints are not believed now; empty if they are."""
        return self._why if self._agreeing < _AGREEING else ""

    def heard(self, number: int | None, now_s: float) -> None:
        """Note the arrival of a message.

        Args:
            number: the publisher's number of the message; None: the middleware gives none.
            now_s: the present time, s, monotonic clock.
        """
        self._now_s, self._numbered = now_s, number is not None
        if number is not None:
            if number <= self._number:
                self._change_publisher()
            self._number = number

    def read(self, q: np.ndarray, at_s: float) -> bool:
        """Judge a reading of joints (n,), rad and m, and return whether they are believed now.

        Args:
            at_s: time of the reading, s.
        """
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
        """Doubt the joints until three readings agree, for the reason `why`."""
        self._agreeing = 0
        if self._now_s >= self._until_s:
            self._why = why

    def _change_publisher(self) -> None:
        """Doubt the joints for a while, because they come from another publisher than before."""
        again = self._now_s - self._changed_s < _RIVALS_S
        rivals = "two publishers tell joint_states in turn: end one of them"
        self._agreeing, self._changed_s = 0, self._now_s
        self._why = rivals if again else "joint_states come from another publisher than before"
        self._until_s = self._now_s + (_RIVALS_S if again else _RESTART_S)
