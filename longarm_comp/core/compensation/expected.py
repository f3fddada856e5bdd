"""The error that a command is expected to leave at the tip, noise of no measurement in it.

It has a part that is known (what was left out of the command on purpose, rounding of the servos)
and one that is not.  A model's record says that one (`core/model/uncertainty.py`); of an arm as
declared the tolerances do; where a predictor is used, its own sigma does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.posture import Posture
from longarm_comp.core.compensation.beyond import not_held
from longarm_comp.core.effects.catalogue import registered
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.ik.engines import posture_at
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.model import Model, Slot, slots_of
from longarm_comp.core.model.tip_motion import stack
from longarm_comp.core.model.uncertainty import ModelUncertainty, sizes

BY_HAND = math.radians(1.0)
"""Zero of a joint, rad, as hands and servo horns set it.  A calibration expects less (`JointZero`):
its rows tell the zeros; before it nothing does."""


@dataclass(frozen=True, eq=False)
class ExpectedMiss:
    """How far the tip may come to rest from its target, or from each of several.

    The known part (..., 3) m, and the covariance (..., 3, 3) m^2 of the rest; NaN: nothing says it.
    """

    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(..., 3) m, standard deviation along each axis."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))

    @cached_property
    def sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """(...) m each: expected distance, and that which 90 of 100 such commands stay below."""
        return sizes(self.covariance, self.mean)

    def beside(self, variance: np.ndarray) -> ExpectedMiss:
        """With a further independent error of a variance (..., 3) along each axis, m^2."""
        further = (variance != 0.0).any(axis=-1, keepdims=True)[..., None]
        whole = np.nan_to_num(self.covariance) + _diagonal(variance)
        return ExpectedMiss(self.mean, np.where(further, whole, self.covariance))


def _diagonal(of: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with (..., 3) on the diagonal."""
    return np.asarray(of[..., None] * np.eye(3))


def expected_miss(
    model: Model,
    q: np.ndarray,
    context: Context,
    pseudo: np.ndarray,
    learned: np.ndarray | None = None,
) -> ExpectedMiss:
    """How far the tip may come to rest from a target, or from each of M, at the commanded joints.

    Args:
        q: (n,) or (M, n) commanded joints, rad and m.
        pseudo: (3,) or (M, 3) m, the target less the learned error.
        learned: of the same shape, m, its sigma (of a measurement), if a predictor is used.
    """
    at = posture_at(model, q, context)
    mean = stack(model.tip_frame(at).p) - pseudo
    known = model.uncertainty
    if known is None:
        if learned is not None:
            return ExpectedMiss(mean, _diagonal(learned**2))
        return ExpectedMiss(mean, _as_declared(model, at).reshape(*mean.shape, 3))
    carried = _carried(known, model, at).reshape(*mean.shape, 3)
    if learned is None:
        return ExpectedMiss(mean, carried + known.structure + known.frame)
    seen = learned**2 - np.diag(known.noise)
    least = np.diagonal(carried, axis1=-2, axis2=-1)
    return ExpectedMiss(mean, _diagonal(np.maximum(seen, least)))


def tolerances(model: Model) -> tuple[tuple[Slot, ...], np.ndarray] | None:
    """What is not known of an arm as declared: k parameters, and (k,) how large each may be.

    That is its geometry, to the tolerances that arm.yaml gives or that are usual, a zero to
    `BY_HAND`; and what yields of it, as in `beyond.not_held`.  Where base and tip are is known,
    unless arm.yaml gives a tolerance: targets are in the base.  None of a model with a geometry of
    its own, whose record is missing.
    """
    if any(effect.geometry for effect in model.effects):
        return None
    held: tuple[tuple[Slot, ...], np.ndarray] | None = model.__dict__.get("_tolerances")
    if held is None:
        arm = model.arm
        geometry = [s for s in slots_of(arm, geometry_of(arm)) if not s.parameter.unknown]
        sizes = [_by_hand(arm, slot) or slot.parameter.width for slot in geometry]
        yielding, by = not_held(model, Context())
        held = (*geometry, *yielding), np.concatenate([sizes, by])
        model.__dict__["_tolerances"] = held
    return held


def _by_hand(arm: Arm, slot: Slot) -> float:
    """`BY_HAND` of a turning joint's zero whose tolerance nobody gave, 0 of all else."""
    if not isinstance(slot.owner, JointZero):
        return 0.0
    joint = arm.joints[slot.owner.joint - 1]
    given = joint.tolerance.theta_deg is not None or joint.type == "prismatic"
    return 0.0 if given else BY_HAND


def geometry_of(arm: Arm) -> list[Effect]:
    """Every geometry effect that the arm may have."""
    kinds = (kind for kind in registered().values() if issubclass(kind, Effect) and kind.geometry)
    return [term for kind in kinds for term in kind.for_arm(arm)]


def _carried(known: ModelUncertainty, model: Model, at: Posture) -> np.ndarray:
    """(N, 3, 3) m^2 that the fitted parameters bring to the tip at N postures."""
    effects = (s for s in model.slots if isinstance(s.owner, Effect))
    held = [slot for slot in effects if slot.identity in known.row]
    columns = model.columns(at, held)[1]
    return known.carried(columns.reshape(-1, 3, len(held)), [slot.identity for slot in held])


def _as_declared(model: Model, at: Posture) -> np.ndarray:
    """(N, 3, 3) m^2 of the tip of an arm as declared at N postures; NaN where nothing says it."""
    declared = tolerances(model)
    if declared is None:
        return np.full((at.count, 3, 3), np.nan)
    slots, sizes = declared
    moved = model.columns(at, slots)[1].reshape(-1, 3, len(slots)) * sizes
    return np.asarray(moved @ np.swapaxes(moved, -1, -2))


@dataclass(frozen=True, eq=False)
class TipByReadings:
    """The tip (3,), m, and what is not known of it."""

    tip: np.ndarray
    doubt: ExpectedMiss

    def said(self, target: np.ndarray | None = None) -> str:
        """In one sentence: where it stands, or how far from a target (3,), m."""
        p90_m = float(self.doubt.sizes[1])
        within = f", within {1e3 * p90_m:.2f} mm" if p90_m > 0 else ""
        if target is not None:
            off = 1e3 * float(np.linalg.norm(self.tip - target))
            return f"by the readings the tip is {off:.2f} mm from the target{within}"
        where = ", ".join(f"{1e3 * v:.2f}" for v in self.tip)
        return f"by the readings the tip is at {where} mm{within}"


def tip_by_readings(model: Model, readings: np.ndarray, context: Context) -> TipByReadings:
    """Where the tip stands by readings (n,), rad and m; the model is that of the commands."""
    arm = by_readings(model)
    tip = arm.tip(readings, context)
    return TipByReadings(tip, expected_miss(arm, readings, context, tip))
