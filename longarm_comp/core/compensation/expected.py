"""The error that a command is expected to leave at the tip, noise of no measurement in it.

It has a part that is known (what was left out of the command on purpose, rounding of the servos)
and one that is not: the parameters, what no parameter explains, the history of the joints.  A
model's record says it (`core/model/uncertainty.py`); of an arm as declared the tolerances do; where
a predictor is used, its own sigma does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.effects.catalogue import registered
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.model.model import Model, slots_of
from longarm_comp.core.model.uncertainty import ModelUncertainty, Stretch, sizes


@dataclass(frozen=True, eq=False)
class ExpectedMiss:
    """How far the tip may come to rest from its target.

    Attributes:
        mean: (3,) m, the part that is known.
        covariance: (3, 3) m^2, of the part that is not; NaN where nothing says it.
    """

    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(3,) m, standard deviation along each axis."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def expected_m(self) -> float:
        """Expected distance from the target, m; NaN where nothing says it."""
        return float(sizes(self.covariance, self.mean)[0])

    @property
    def p90_m(self) -> float:
        """Distance that 90 of 100 such commands stay below, m; NaN where nothing says it."""
        return float(sizes(self.covariance, self.mean)[1])

    def beside(self, variance: np.ndarray) -> ExpectedMiss:
        """With a further independent error of a variance (3,) along each axis, m^2."""
        whole = np.nan_to_num(self.covariance) + np.diag(variance)
        return self if not variance.any() else ExpectedMiss(self.mean, whole)


UNKNOWN = ExpectedMiss(np.zeros(3), np.full((3, 3), np.nan))


def expected_miss(
    model: Model,
    q: np.ndarray,
    context: Context,
    pseudo: np.ndarray,
    learned: np.ndarray | None = None,
) -> ExpectedMiss:
    """How far the tip may come to rest from a target, at the commanded joints.

    Args:
        q: (n,) commanded joints, rad and m.
        pseudo: (3,) m, the target less the learned error.
        learned: (3,) m, its sigma (of a measurement), if a predictor is used.
    """
    at = model.posture(tuple(q.tolist()), context)
    mean = np.array(model.tip_frame(at).p) - pseudo
    known = model.uncertainty or of_tolerances(model)
    if learned is not None and model.uncertainty is None:
        return ExpectedMiss(mean, np.diag(learned**2))
    if known is None:
        return ExpectedMiss(mean, UNKNOWN.covariance)
    carried = _carried(known, model, at)
    if learned is None:
        return ExpectedMiss(mean, carried + known.structure)
    seen = learned**2 - np.diag(known.noise)
    return ExpectedMiss(mean, np.diag(np.maximum(seen, np.diag(carried))))


def inside_data(model: Model, miss: ExpectedMiss) -> bool:
    """Whether a model's own error at some joints is one that its fitted rows have too."""
    known = model.uncertainty
    return known is not None and miss.expected_m <= known.largest_m


def of_tolerances(model: Model) -> ModelUncertainty | None:
    """What is not known of an arm as declared: its geometry, to the tolerances.

    Where base and tip are is known, unless arm.yaml gives a tolerance: targets are in the base.
    None of a model with a geometry of its own, whose record is missing.
    """
    if any(effect.geometry for effect in model.effects):
        return None
    held: ModelUncertainty | None = model.__dict__.get("_tolerances")
    if held is None:
        slots = [s for s in slots_of(model.arm, geometry_of(model.arm)) if not s.parameter.unknown]
        widths = np.array([slot.parameter.width for slot in slots])
        none = np.zeros((3, 3))
        names = tuple(slot.identity for slot in slots)
        held = ModelUncertainty(names, np.diag(widths), Stretch(), none, none, np.inf, 0)
        model.__dict__["_tolerances"] = held
    return held


def geometry_of(arm: Arm) -> list[Effect]:
    """Every geometry effect that the arm may have."""
    kinds = (kind for kind in registered().values() if issubclass(kind, Effect) and kind.geometry)
    return [term for kind in kinds for term in kind.for_arm(arm)]


def _carried(known: ModelUncertainty, model: Model, at: Posture) -> np.ndarray:
    """(3, 3) m^2 that the parameters bring to the tip at a posture."""
    names = set(known.slots)
    terms = model.effects if model.uncertainty is known else geometry_of(model.arm)
    slots = [slot for slot in slots_of(model.arm, terms) if slot.identity in names]
    columns = model.columns(at, slots)[1].reshape(1, 3, -1)
    return known.carried(columns, [slot.identity for slot in slots])[0]
