"""What is known of the running arm right now, as the circumstances of a target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.errors import JobError
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
    started_s: float = 0.0

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
        columns = {"t_s": now_s - self.started_s}
        ages: dict[str, float] = {}
        for reading in sorted(self.readings.values(), key=lambda reading: reading.at_s):
            age = now_s - reading.at_s
            ages.update(dict.fromkeys(reading.columns, age))
            columns.update(reading.columns if age <= max_age_s else {})
        old = {name: age for name, age in ages.items() if age > max_age_s}
        context = Context(**({} if history is None else history.fields()), columns=columns)
        if "payload_kg" in old and model.arm.payload is not None:
            raise _stale("payload_kg", old)
        for effect in model.effects:
            if name := effect.missing(context):
                raise _stale(name, old)
        return context


def _stale(column: str, old: Mapping[str, float]) -> StaleContext:
    if column in old:
        return StaleContext(f"{column} is {old[column]:.1f} s old", column=column)
    return StaleContext(f"{column} was never published, and the model needs it", column=column)
