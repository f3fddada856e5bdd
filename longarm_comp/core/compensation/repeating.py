"""The errors of a model that repeat, estimated from sightings as long as nothing changes.

The error that a command promises is mostly the same at each visit to a pose: that of the
parameters, of the frame, of what no parameter explains. A test of independent samples would take it
for a change.  So a Kalman filter follows it, beginning with what the model promises.  What it did
not expect of a sighting is independent of all sightings before, while nothing changes.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.expected import list_tolerances
from longarm_comp.core.compensation.sighting import (
    COMMON,
    PAYLOAD,
    SHARED,
    VISITED,
    error_of_sighting,
    is_other_payload,
    visit,
)
from longarm_comp.core.model.model import Model, Slot, slots_of
from longarm_comp.core.model.uncertainty import ModelUncertainty, factor_of


@dataclass(frozen=True, eq=False)
class Unexpected:
    """The part of one sighting that was not expected."""

    off: np.ndarray  # (3,) m, the sighting less its expectation after all sightings before
    covariance: np.ndarray  # (3, 3) m^2, of `off` while nothing changes
    after: RepeatingErrors  # the errors as they are known with this sighting

    def spread(self, least_m: float, turn: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance (3, 3), m^2, with a standard deviation of `least_m` or more.

        Args:
            turn: (3, 3) rotation from the model's axes to those of the result.
        """
        values, axes = np.linalg.eigh(self.covariance)
        axes = axes if turn is None else turn @ axes
        return np.asarray((axes * np.maximum(values, least_m**2)) @ axes.T)


@dataclass(frozen=True, eq=False)
class RepeatingErrors:
    """Estimate of the errors of p parameters, those that all sightings share, and of each pose.

    Attributes:
        model: the model that predicts.
        promised: its uncertainty; for a declared arm that of its tolerances.
        slots: the p parameters.
        mean: (p + COMMON + 3 + 3 VISITED,) of the errors: parameters, shared, of the region, of
            each pose.
        covariance: of these errors.
        visited: as of `visit`.
        payload_kg: payload at the last sighting.
    """

    model: Model
    promised: ModelUncertainty
    slots: tuple[Slot, ...]
    mean: np.ndarray
    covariance: np.ndarray
    visited: tuple[tuple[int, np.ndarray], ...] = ()
    payload_kg: float = math.nan

    @classmethod
    def of(cls, model: Model) -> RepeatingErrors:
        """Begin with what a model promises."""
        promised, slots = model.uncertainty, tuple[Slot, ...]()
        if promised is None:
            slots, widths = list_tolerances(model) or ((), np.zeros(0))
            names, none = tuple(slot.identity for slot in slots), np.zeros((3, 3))
            promised = ModelUncertainty(names, np.diag(widths), none, none, 0.0, 0)
        else:
            held = {term.key for term in model.terms}
            absent = [term for term in promised.absent if term.key not in held]
            slots = tuple(
                slot
                for slot in (*model.slots, *slots_of(model.arm, absent))
                if slot.identity in promised.row
            )
        factor = promised.factor[[promised.row[slot.identity] for slot in slots]]
        p, count = len(slots), len(slots) + COMMON + 3 + 3 * VISITED
        covariance = np.zeros((count, count))
        covariance[:p, :p] = factor @ factor.T
        covariance[p : p + COMMON + 3, p : p + COMMON + 3] = np.eye(COMMON + 3)
        return cls(model, promised, slots, np.zeros(count), covariance)

    def compare(
        self,
        q: np.ndarray,
        context: Context,
        tip: np.ndarray,
        variance: np.ndarray,
        learned: np.ndarray | None = None,
    ) -> Unexpected:
        """Compare a sighting of an arm at rest with what is expected of it.

        Args:
            q, context, variance, learned: as in `error_of_sighting`.
            tip: (3,) m, the measured position, less the error that a predictor expects.
        """
        model, p = self.model, len(self.slots)
        error = error_of_sighting(model, self.promised, q, context, variance, learned)
        arm = model.arm
        place, is_new, visited = visit(self.visited, (q - arm.lower) / (arm.upper - arm.lower))
        known = self
        if is_other_payload(self.payload_kg, context):
            known = known._with_anew(p + PAYLOAD, np.eye(1))
        own = p + COMMON + 3 + 3 * place
        if is_new:
            known = known._with_anew(own, SHARED * error.structure)
        point, columns = model.columns(model.posture(tuple(q.tolist()), context), self.slots)
        a = np.zeros((3, len(self.mean)))
        a[:, :p], a[:, p : p + COMMON] = columns.reshape(3, p), error.common
        # The same at all poses of a job, which may lie close together
        a[:, p + COMMON : p + COMMON + 3] = math.sqrt(SHARED) * factor_of(error.structure)
        a[:, own : own + 3] = np.eye(3)
        carried = known.covariance @ a.T
        spread = a @ carried + error.noise + error.structure
        off = tip - point.reshape(3) - a @ known.mean
        gain = carried @ np.linalg.pinv(spread, hermitian=True)
        covariance = known.covariance - gain @ carried.T
        after = dataclasses.replace(
            self,
            mean=known.mean + gain @ off,
            covariance=(covariance + covariance.T) / 2.0,
            visited=visited,
            payload_kg=float(context.payload_kg(0.0)),
        )
        return Unexpected(off, spread, after)

    def _with_anew(self, first: int, prior: np.ndarray) -> RepeatingErrors:
        """Return the estimate with the errors from number `first` on reset to a prior."""
        own = slice(first, first + len(prior))
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[own] = covariance[own] = covariance[:, own] = 0.0
        covariance[own, own] = prior
        return dataclasses.replace(self, mean=mean, covariance=covariance)
