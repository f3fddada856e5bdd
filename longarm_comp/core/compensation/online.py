"""One target on the running arm: what is known right now becomes a context, then a compensation.

Pure: time and readings are handed in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.compensate import (
    Compensation,
    Method,
    Predictor,
    Settling,
    compensate,
    rigid,
)
from longarm_comp.core.data.session import derive_approach
from longarm_comp.core.errors import InputError, JobError
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.model.model import Model


class StaleContext(JobError):  # noqa: N818
    """A circumstance that the model needs was never told, or too long ago."""


@dataclass(frozen=True)
class Reading:
    """What one source told last: columns as `Context` names them, and when (s, monotonic)."""

    columns: Mapping[str, float]
    at_s: float


@dataclass(frozen=True)
class Readings:
    """The last reading of every source (temperature, payload, inclination of a frame)."""

    readings: Mapping[str, Reading] = field(default_factory=dict)
    started_s: float = 0.0

    def told(self, source: str, columns: Mapping[str, float], at_s: float) -> Readings:
        """With a new reading."""
        return replace(self, readings={**self.readings, source: Reading(columns, at_s)})

    def context(
        self, model: Model, now_s: float, max_age_s: float, approach: np.ndarray | None = None
    ) -> Context:
        """The context of a target that is asked for now.

        A payload that was never told is the declared one.

        Args:
            approach: (n,) of -1, 0, +1, side that the joints will arrive from.

        Raises:
            StaleContext: an effect of the model, or the load, needs what is older than
                ``max_age_s`` or was never told.
        """
        columns = {"t_s": now_s - self.started_s}
        old: dict[str, float] = {}
        for reading in self.readings.values():
            age = now_s - reading.at_s
            (columns if age <= max_age_s else old).update(
                reading.columns if age <= max_age_s else dict.fromkeys(reading.columns, age)
            )
        made = Context(() if approach is None else tuple(float(a) for a in approach), columns)
        if "payload_kg" in old and model.arm.payload is not None:
            raise _stale("payload_kg", old)
        for effect in model.effects:
            try:
                effect.require(made)
            except InputError as error:
                if error.field == "approach":
                    continue
                raise _stale(error.field, old) from error
        return made


def _stale(column: str, old: Mapping[str, float]) -> StaleContext:
    if column in old:
        return StaleContext(f"{column} is {old[column]:.1f} s old", column=column)
    return StaleContext(f"{column} was never told, and the model needs it", column=column)


@dataclass(frozen=True)
class CompensationOptions:
    """How far compensation may go; as in `compensate`."""

    method: Method = Method.BOTH
    settling: Settling = field(default_factory=Settling)
    locked: tuple[int, ...] = ()


def arrival(path: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Side (n,) of -1, 0, +1 that each joint arrives from at the end of a path.

    Args:
        path: (k, n) way-points, the first being where the joints stand.
        before: (n,) side that they arrived from there; kept by joints that do not move.
    """
    recorded = np.zeros(path.shape)
    recorded[0] = before
    return derive_approach(path, np.arange(len(path)), recorded)[-1]


def compensate_now(
    model: Model,
    predictor: Predictor | None,
    target: np.ndarray,
    *,
    start: np.ndarray,
    side: np.ndarray,
    circumstances: Readings,
    now_s: float,
    max_age_s: float,
    position_only: bool = False,
    limits: CompensationOptions | None = None,
) -> tuple[Compensation, Context]:
    """Compensate one target from where the arm is.

    Where an effect depends on the side that joints arrive from, the joints are found twice:
    the first solution says from which side.

    Args:
        target: (3,) m or (4, 4), base frame.
        start: (n,) joints now (rad, m); also the seed.
        side: (n,) side that the joints arrived from at ``start``.

    Returns:
        The outcome, and the context that the effects saw.

    Raises:
        StaleContext: see `Readings.context`.
    """
    limits = limits or CompensationOptions()
    physics = model if limits.method.physics else rigid(model)
    context = circumstances.context(physics, now_s, max_age_s, side)
    if any("approach" in effect.needs for effect in physics.effects):
        first = ik.solve(
            physics, target, seed=start, context=context, position_only=position_only,
            locked=limits.locked,
        )  # fmt: skip
        context = circumstances.context(
            physics, now_s, max_age_s, arrival(np.stack([start, first.q]), side)
        )
    made = compensate(
        model,
        predictor,
        target,
        context=context,
        seed=start,
        position_only=position_only,
        method=limits.method,
        locked=limits.locked,
        **vars(limits.settling),
    )
    return made, context
