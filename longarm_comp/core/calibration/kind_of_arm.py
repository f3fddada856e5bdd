"""The prior that calibrated arms of one kind give a further one, before it is measured.

The errors of arms of one kind are related: parts are made on the same machines and zeros are set by
the same hands.  Their second moment, shrunk towards the drawing's tolerances after Ledoit and Wolf
(2004, J. Multivariate Anal. 88), is the prior of the next arm: some directions, each with a
free amount, and a share of the tolerances for the rest.
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
"""Arms that say how arms of their kind differ; of two, one direction is all that is seen."""
_TABLE = ("type", "a_m", "alpha_deg", "d_m", "theta_offset_deg", "pose")


@dataclass(frozen=True)
class KindOfArm:
    """The prior of a further arm of a kind.

    Attributes:
        directions: directions of errors that the arms share.
        rest: share of the tolerances by which every single error may be off besides.
        noise: scatter of the arms' measurements, by kind of measurement, m or rad.
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
        """Find the prior from calibrated models of arms of the kind.

        Args:
            arm: the further arm, as declared.
            models, sources: models of the others, and their files, for messages.
            noise: as the attribute, where it is known.

        Raises:
            InputError: there are too few models, or one has another table of rows.
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
        """Return a model of the further arm whose geometry has this prior."""
        parts = {
            t.key: _with_zero_values(t) for d in self.directions for t in d.terms if not t.geometry
        }
        whole = model.with_missing(parts.values()).with_missing(self.directions)
        return dataclasses.replace(whole, tolerances=self.rest)


def fold_directions(fit: ModelFit) -> ModelFit:
    """Return a fit whose shared directions are replaced by the single errors that they consist
    of."""
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
    """Return the rows that arms of one kind have in common."""
    return tuple(tuple(repr(getattr(j, name)) for name in _TABLE) for j in arm.joints)


def _check_table(arm: Arm, other: Arm, source: str) -> None:
    """Refuse an arm with another table, because its errors are not errors of this one."""
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
    """Shrink the second moment of (n, p) errors, in tolerances, of n arms.

    The second moment S becomes ``(1 - w) S + w m I``, with m the mean of its diagonal and w the
    share that is expected to be closest to the truth.

    Returns:
        Directions (k, p), and the standard deviation of the rest.
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
