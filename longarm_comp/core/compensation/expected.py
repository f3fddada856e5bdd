"""The error that a command is expected to leave at the tip, without the noise of a measurement.

It has a known part (effects that the command leaves out, rounding to the servos' steps) and an
unknown part.  The unknown part follows from the model's uncertainty
(`core/model/uncertainty.py`), for a declared arm from its tolerances, and with a predictor from the
predictor's own sigma.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.beyond import absent_slots
from longarm_comp.core.compensation.unshown import structure_left
from longarm_comp.core.effects.catalogue import registered
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.ik.columns import tip_and_columns
from longarm_comp.core.ik.engines import tip_poses
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.model import Model, Slot, slots_of
from longarm_comp.core.model.uncertainty import Alternative, list_told, sizes

BY_HAND = math.radians(1.0)
"""Usual error of a joint's zero, rad, that was set by hand or by a servo horn. It holds for an arm
that is not calibrated; a calibration expects less (`JointZero`)."""


@dataclass(frozen=True, eq=False)
class ExpectedMiss:
    """The error with which the tip may come to rest at its target, or at each of several.

    Attributes:
        mean: (..., 3) m, the known part.
        covariance: (..., 3, 3) m^2 of the unknown part; NaN if not known. It is about the model's
            tip, so the alternatives count in it.
        chance: (A,) probability of each alternative explanation.
        apart: (A, ..., 3) m, its tip less the model's.
        further: (A, ..., 3, 3) m^2, covariance of that difference.
    """

    mean: np.ndarray
    covariance: np.ndarray
    chance: np.ndarray = field(default_factory=lambda: np.zeros(0))
    apart: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    further: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation along each axis, (..., 3) m."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))

    @cached_property
    def sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """The expected distance from the target, and that of 90 of 100 commands, (...) m each."""
        if not len(self.chance):
            return sizes(self.covariance, self.mean)
        alone = self.covariance - spread_of(self.chance, self.apart, self.further)
        covariances = np.concatenate([alone[None], alone + self.further])
        means = np.concatenate([self.mean[None], self.mean + self.apart])
        return sizes(covariances, means, np.append(1.0 - self.chance.sum(), self.chance))

    def plus(self, covariance: np.ndarray) -> ExpectedMiss:
        """Return the miss with a further independent error of covariance (..., 3, 3), m^2.

        An unknown covariance stays NaN, because a part of an error is no bound of the whole.
        """
        return replace(self, covariance=self.covariance + covariance)


def spread_of(chance: np.ndarray, apart: np.ndarray, further: np.ndarray) -> np.ndarray:
    """Return the covariance (..., 3, 3), m^2, about the model's tip that A alternatives cause."""
    return np.tensordot(chance, apart[..., None] * apart[..., None, :] + further, axes=1)


def expected_miss(
    model: Model,
    q: np.ndarray,
    context: Context,
    pseudo: np.ndarray,
    learned: np.ndarray | None = None,
) -> ExpectedMiss:
    """Estimate how far the tip may come to rest from a target, or from each of M.

    Args:
        q: (n,) or (M, n) commanded joints, rad and m.
        context: circumstances of all, or of each.
        pseudo: (3,) or (M, 3) m, the target less the learned error.
        learned: (3,) or (M, 3) m, sigma of the learned error, if a predictor is used.
    """
    known = model.uncertainty
    declared = list_tolerances(model) if known is None and learned is None else None
    if known is None and declared is None:  # the tip alone, which is quicker than a posture
        tip = tip_poses(model, np.atleast_2d(q), context)[:, :3, 3]
        variance = np.full(pseudo.shape, np.nan) if learned is None else learned**2
        covariance = variance[..., None] * np.eye(3)
        return ExpectedMiss(tip.reshape(pseudo.shape) - pseudo, covariance)
    if known is None:
        assert declared is not None
        slots, widths = declared
        tip, columns = tip_and_columns(model, q, context, slots)
        mean, moved = tip - pseudo, columns * widths
        covariance = moved @ np.swapaxes(moved, -1, -2)
        return ExpectedMiss(mean, covariance.reshape(*mean.shape, 3))
    if "uncertain" not in model.memo:
        model.memo["uncertain"] = model.uncertain_slots(known)
    slots = model.memo["uncertain"]
    others = list_told(known.alternatives, context)
    more, chance, moves = _alternative_slots(model, others)
    tip, columns = tip_and_columns(model, q, context, (*slots, *more))
    mean = tip - pseudo
    carried = known.carry_to_tip(columns, [slot.identity for slot in (*slots, *more)])
    carried = carried.reshape(*mean.shape, 3)
    apart, *ways = np.einsum("nip,kap->kani", columns, moves).reshape(
        len(moves), len(others), *mean.shape
    )
    further = sum((way[..., None] * way[..., None, :] for way in ways), np.zeros((*apart.shape, 3)))
    carried = carried + spread_of(chance, apart, further)
    if learned is None:
        structure = structure_left(model, known, np.atleast_2d(q), context).reshape(carried.shape)
        return ExpectedMiss(mean, carried + structure + known.frame, chance, apart, further)
    seen = learned**2 - np.diag(known.noise)
    least = np.diagonal(carried, axis1=-2, axis2=-1)
    return ExpectedMiss(mean, np.maximum(seen, least)[..., None] * np.eye(3) + known.frame)


def _alternative_slots(
    model: Model, others: tuple[Alternative, ...]
) -> tuple[tuple[Slot, ...], np.ndarray, np.ndarray]:
    """Return the parameters of A alternatives that the model does not hold, and what they change.

    Returns:
        The parameters; the probabilities (A,); and the moves (1 + k, A, p), as of `Alternative`, of
        the model's uncertain parameters, then of these.
    """
    name = f"alternatives {[id(a) for a in others]}"
    if name not in model.memo:
        terms = {t.variant: t for a in others for t in a.terms}
        known = [slot.identity for slot in model.memo["uncertain"]]
        slots = slots_of(model.arm, list(terms.values()))
        more = tuple(slot for slot in slots if slot.identity not in known)
        every = [*known, *(slot.identity for slot in more)]
        most = max((len(a.moves) for a in others), default=1)
        moves = np.zeros((most, len(others), len(every)))
        for k, other in enumerate(others):
            moves[: len(other.moves), k] = other.moves_of(every)
        model.memo[name] = more, np.array([a.chance for a in others]), moves
    held: tuple[tuple[Slot, ...], np.ndarray, np.ndarray] = model.memo[name]
    return held


def list_tolerances(model: Model) -> tuple[tuple[Slot, ...], np.ndarray] | None:
    """Return k unknown parameters of a declared arm, and their (k,) standard deviations.

    They are its geometry, with the tolerances that arm.yaml gives or usual ones (`BY_HAND` for
    joint zeros), and its compliances, as in `beyond.absent_slots`.  Base and tip count as known
    unless arm.yaml gives a tolerance, because targets are in the base frame.  None is returned for
    a model with fitted geometry: its uncertainty should be in the model and is missing.
    """
    if any(effect.geometry for effect in model.effects):
        return None
    if "tolerances" not in model.memo:
        arm = model.arm
        geometry = [s for s in slots_of(arm, geometry_of(arm)) if not s.parameter.unknown]
        widths = [slot.parameter.width for slot in geometry]
        for k, owner in enumerate(slot.owner for slot in geometry):
            if isinstance(owner, JointZero):
                joint = arm.joints[owner.joint - 1]
                if joint.type != "prismatic" and joint.tolerance.theta_deg is None:
                    widths[k] = BY_HAND
        yielding, by = absent_slots(model, Context())
        model.memo["tolerances"] = (*geometry, *yielding), np.concatenate([widths, by])
    held: tuple[tuple[Slot, ...], np.ndarray] = model.memo["tolerances"]
    return held


def geometry_of(arm: Arm) -> list[Effect]:
    """Return every geometry effect that the arm may have, at each of its places."""
    kinds = (kind for kind in registered().values() if issubclass(kind, Effect) and kind.geometry)
    return [term for kind in kinds for term in kind.for_arm(arm)]


@dataclass(frozen=True, eq=False)
class TipByReadings:
    """The tip (3,), m, computed from the readings of the joints, and how far off it may be."""

    tip: np.ndarray
    doubt: ExpectedMiss

    def describe(self, target: np.ndarray | None = None) -> str:
        """Say in a phrase where the tip stands, or how far it is from a target (3,), m."""
        p90_m = float(self.doubt.sizes[1])
        within = f", within {1e3 * p90_m:.2f} mm" if p90_m > 0 else ""
        if target is not None:
            off = 1e3 * float(np.linalg.norm(self.tip - target))
            return f"by the readings the tip is {off:.2f} mm from the target{within}"
        where = ", ".join(f"{1e3 * v:.2f}" for v in self.tip)
        return f"by the readings the tip is at {where} mm{within}"


def tip_by_readings(model: Model, readings: np.ndarray, context: Context) -> TipByReadings:
    """Compute the tip from readings (n,) of the joints, rad and m.

    Args:
        model: a model that predicts the tip from commands; it is converted to readings here.
    """
    arm = by_readings(model)
    tip = arm.tip(readings, context)
    return TipByReadings(tip, expected_miss(arm, readings, context, tip))
