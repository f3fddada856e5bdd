"""The prior of an arm's errors from calibrated arms of the same kind.

The errors of arms of one kind are correlated: their parts are made on the same machines, and the
same people set their zeros.  The second moment of the errors, shrunk towards the drawing's
tolerances after Ledoit and Wolf (2004, J. Multivariate Anal. 88), is the prior of the next arm.  It
consists of some directions, each with a free amount, and a fraction of the tolerances for what the
directions leave.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.measurement import compute_posture, make_equations
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import KindDirection
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model, Slot, slots_of

LEAST = 3
"""Smallest number of calibrated arms from which a prior is made."""
_TABLE = ("type", "a_m", "alpha_deg", "d_m", "theta_offset_deg", "pose")


@dataclass(frozen=True)
class KindOfArm:
    """The prior of the errors of one more arm of a kind, from arms that are already calibrated.

    Attributes:
        directions: directions (combinations of errors) that the arms have in common.
        rest: prior standard deviation of what the directions leave of each single error, as a
            fraction of its tolerance.
        noise: usual noise of the arms' measurements, by kind of measurement, m or rad.
    """

    directions: tuple[KindDirection, ...]
    rest: float
    noise: Mapping[str, float]

    @classmethod
    def of(
        cls,
        arm: Arm,
        models: Sequence[Model],
        sources: Sequence[str],
        noise: Mapping[str, float] | None = None,
    ) -> KindOfArm:
        """Make the prior from calibrated models of arms of the same kind.

        Args:
            arm: the arm that gets the prior, as declared.
            models: models of the other arms.
            sources: their files, for error messages.
            noise: usual noise, as the attribute, if it is known.

        Raises:
            InputError: there are too few models, or one has other DH rows.
        """
        if len(models) < LEAST:
            raise InputError("kind of arm", "models", len(models), f"at least {LEAST}, of one kind")
        for model, source in zip(models, sources, strict=True):
            _check_table(arm, model.arm, source)
        slots: dict[tuple[object, ...], Slot] = {}
        values = []  # in tolerances, of what arms share: not where one, or its tool, was put
        for model in models:
            drawn = dataclasses.replace(model, tolerances=1.0, beyond=())
            shared = [
                s
                for s in drawn.slots
                if isinstance(s.owner, Effect) and not s.parameter.unknown and not s.owner.passing
            ]
            slots |= {s.identity: s for s in shared}
            values.append({s.identity: s.value / s.parameter.width for s in shared})
        shares, rest = _shrink(np.array([[each.get(key, 0.0) for key in slots] for each in values]))
        directions = []
        for number, share in enumerate(shares, 1):
            terms: dict[tuple[object, ...], Effect] = {}
            for slot, value in zip(slots.values(), share, strict=True):
                key = (slot.owner.name, *slot.owner.placement.items())
                term = terms.get(key) or _with_zero_values(slot.owner)  # type: ignore[arg-type]
                terms[key] = term.with_values({slot.parameter.name: value * slot.parameter.width})
            directions.append(KindDirection(number, tuple(terms.values())))
        return cls(tuple(directions), rest, noise or {})

    def apply_to(self, model: Model) -> Model:
        """Return a model of the arm with this prior of its geometry."""
        parts = {
            t.key: _with_zero_values(t) for d in self.directions for t in d.terms if not t.geometry
        }
        whole = model.with_missing(parts.values()).with_missing(self.directions)
        return dataclasses.replace(whole, tolerances=self.rest)


def fold_directions(fit: ModelFit) -> ModelFit:
    """Return the fit with each `KindDirection` replaced by the single errors that it combines."""
    kept = tuple(e for e in fit.model.effects if not isinstance(e, KindDirection))
    if kept == fit.model.effects:
        return fit
    model = dataclasses.replace(fit.model, effects=kept, tolerances=1.0)
    place = {slot.identity: k for k, slot in enumerate(model.slots)}
    ways = np.zeros((len(place), len(fit.slots)))
    for k, slot in enumerate(fit.slots):
        if isinstance(slot.owner, KindDirection):
            for part in slots_of(model.arm, slot.owner.terms):
                ways[place[part.identity], k] += part.value
        else:
            ways[place[slot.identity], k] = 1.0
    model = model.with_values(ways @ fit.model.values)
    covariance = ways @ fit.covariance @ ways.T
    at = compute_posture(model, fit.session)
    return dataclasses.replace(
        fit,
        model=model,
        posture=at,
        columns=make_equations(model, fit.session, at=at).columns,
        covariance=covariance,
    )


def describe_table(arm: Arm) -> tuple[tuple[object, ...], ...]:
    """Return the DH rows in a comparable form; arms of one kind have the same ones."""
    return tuple(tuple(repr(getattr(j, name)) for name in _TABLE) for j in arm.joints)


def _check_table(arm: Arm, other: Arm, source: str) -> None:
    """Raise `InputError` if another arm has other DH rows: its errors then have another meaning."""
    if len(arm.joints) != len(other.joints):
        rows = f"{len(arm.joints)} rows, as {arm.name}"
        raise InputError(source, "joints", f"{len(other.joints)} rows", rows)
    for mine, its in zip(arm.joints, other.joints, strict=True):
        for name in _TABLE:
            if getattr(mine, name) != getattr(its, name):
                allowed = f"{getattr(mine, name)}, as {arm.name}: arms of one kind have one table"
                raise InputError(
                    source, f"joints.{mine.id - 1}.{name}", getattr(its, name), allowed
                )


def _shrink(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Shrink the second moment of the errors of n arms.

    The second moment S becomes ``(1 - w) S + w m I``, with m the mean of its diagonal, and w the
    weight with the smallest expected error.

    Args:
        values: (n, p) errors, in units of their tolerances.

    Returns:
        The directions (k, p) of the first part, scaled by their standard deviations, and the
        standard deviation of the second part.
    """
    n, p = values.shape
    moment = values.T @ values / n
    mean = float(np.trace(moment)) / p
    off = float(((moment - mean * np.eye(p)) ** 2).sum())
    scatter = sum(float(((np.outer(z, z) - moment) ** 2).sum()) for z in values) / n**2
    weight = min(scatter / off, 1.0) if off > 0 else 1.0
    size, way = np.linalg.eigh(moment)
    large = size > 1e-9 * max(size.max(), 1e-300)
    ways = way[:, large].T * np.sqrt((1.0 - weight) * size[large])[:, None]
    return ways, float(np.sqrt(weight * mean))


def _with_zero_values(term: Effect) -> Effect:
    return term.with_values({p.name: 0.0 for p in term.declared()})
