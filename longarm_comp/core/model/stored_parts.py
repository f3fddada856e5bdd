"""Terms and uncertainty of a model as `model.yaml` holds them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, get_type_hints

import numpy as np
from pydantic import Field, model_validator

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Vec3
from longarm_comp.core.effects.catalogue import effect_class, possible_compliances
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.domain import RowDomain
from longarm_comp.core.model.model import Model, slots_of
from longarm_comp.core.model.uncertainty import (
    Alternative,
    ModelUncertainty,
    decode_numbers,
    decode_triangle,
    encode_numbers,
    encode_triangle,
    triangular,
)
from longarm_comp.core.yaml_file import Declared, Misdeclared


class StoredValue(Declared):
    """One parameter: SI value, unit and 95 % interval."""

    value: float
    unit: str
    ci95: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> StoredValue:
        if self.ci95 is not None and not self.ci95[0] <= self.ci95[1]:
            raise Misdeclared("ci95", list(self.ci95), "[lower, upper] with lower <= upper")
        return self


class StoredTerm(Declared):
    """One effect or bias: canonical name, place, form, values, origin."""

    effect: str
    where: str
    form: dict[str, int | float | str] = Field(default_factory=dict)
    parameters: dict[str, StoredValue] = Field(default_factory=dict)
    origin: str = ""


def store_term(
    term: Effect | Bias,
    arm: Arm,
    ends: Mapping[str, tuple[float, float]] | None = None,
    origin: str = "",
) -> StoredTerm:
    """Return the stored form of a term.

    Args:
        ends: 95 % intervals by parameter.
        origin: where it is from.
    """
    ends, parameters = ends or {}, {}
    for p in term.parameters(arm):
        value = float(getattr(term, p.name))
        parameters[p.name] = StoredValue(value=value, unit=p.unit, ci95=ends.get(p.name))
    return StoredTerm(
        effect=term.name,
        where=term.where,
        form=term.placement,
        parameters=parameters,
        origin=origin,
    )


def restore_term(entry: StoredTerm, arm: Arm, where: str, known_from: str = "") -> Effect | Bias:
    """Return the effect or bias of an entry, after checking its place and values on the arm."""
    kind = effect_class(entry.effect, where, known_from)
    known = {f.name for f in dataclasses.fields(kind)}
    for name in (*entry.form, *entry.parameters):
        if name not in known:
            allowed = ", ".join(sorted(known))
            raise InputError(where, f"{entry.effect}.{name}", "unknown", allowed)
    values = {name: stored.value for name, stored in entry.parameters.items()}
    try:
        term = kind(**entry.form, **values)
    except TypeError as error:
        raise InputError(where, entry.effect, entry.form, str(error)) from error
    _check_placement(term, arm, where)
    term.check(arm, where)
    for p in term.parameters(arm):
        field, value = f"{entry.effect}.{p.name}", getattr(term, p.name)
        if p.name in values and entry.parameters[p.name].unit != p.unit:
            raise InputError(where, field, entry.parameters[p.name].unit, p.unit)
        if not p.lower <= value <= p.upper:
            raise InputError(where, field, value, f"{p.lower}..{p.upper}")
    return term


def _check_placement(term: Effect | Bias, arm: Arm, where: str) -> None:
    """Check that a term's places and scales have the declared type and exist on this arm."""
    kinds = get_type_hints(type(term))
    for name, value in term.placement.items():
        kind = kinds[name]
        fits = type(value) is kind or (kind is float and type(value) is int)
        if kind in (int, float, str) and not fits:
            allowed = {int: "a whole number", float: "a number", str: "text"}[kind]
            raise InputError(where, f"{term.name}.{name}", value, allowed)
    for name, (lower, upper) in term.scales().items():
        if not lower <= getattr(term, name) <= upper:
            raise InputError(where, f"{term.name}.{name}", getattr(term, name), f"{lower}..{upper}")
    for name, places in term.allowed_places().items():
        if term.places[name] not in (exist := list(places(arm))):
            raise InputError(where, f"{term.name}.{name}", term.places[name], exist)


_Square = tuple[Vec3, Vec3, Vec3]
_ZERO: _Square = ((0.0, 0.0, 0.0),) * 3


class StoredDomain(Declared):
    """A stored `RowDomain`."""

    places: list[str] = Field(description="joints of rows far apart, a line a joint in base 64")
    span: list[Annotated[float, Field(ge=0.0)]] = Field(
        description="range of each joint, rad or m; 0 for a joint that hardly moved"
    )
    amid: float = Field(gt=0.0, description="usual variance amid the rows, as a share of that far")


class StoredAlternative(Declared):
    """A stored `Alternative`."""

    chance: float = Field(gt=0.0, lt=1.0)
    terms: list[StoredTerm] = Field(description="effects that are not held")
    moves: list[str] = Field(
        min_length=1,
        description="changes of the parameters, in the order of the file, then of its terms, and "
        "what one standard deviation of each of its terms' moves; in base 64",
    )


class StoredUncertainty(Declared):
    """A stored `ModelUncertainty`, with the parameters in the order of the file."""

    factor: list[str] = Field(description="triangle of the covariance, rows in base 64")
    structure_m2: _Square
    noise_m2: _Square
    largest_m: float = Field(ge=0.0)
    rows: int = Field(ge=0)
    frame_m2: _Square = _ZERO
    circumstances: dict[str, tuple[float, float]] = Field(
        default_factory=dict, description="lowest and highest of the session, by column"
    )
    absent: list[StoredTerm] = Field(
        default_factory=list, description="effects that are not held; parameters after the others"
    )
    domain: StoredDomain | None = Field(default=None, description="where the rows stood")
    alternatives: list[StoredAlternative] = Field(
        default_factory=list, description="other explanations of the rows"
    )


def store_uncertainty(model: Model) -> StoredUncertainty | None:
    """Return the model's uncertainty, with parameters in the order in which `restore` has them."""
    known = model.uncertainty
    if known is None:
        return None
    kept = [t for t in model.terms if not t.passing]
    in_file = sorted(kept, key=lambda t: 2 if isinstance(t, Bias) else int(not t.geometry))
    held = [slot.identity for slot in slots_of(model.arm, in_file)]
    order = [*held, *(slot.identity for slot in slots_of(model.arm, known.absent))]
    factor = np.zeros((len(order), known.factor.shape[1]))
    for k, identity in enumerate(order):
        if identity in known.row:
            factor[k] = known.factor[known.row[identity]]
    return StoredUncertainty(
        factor=encode_triangle(triangular(factor)),
        structure_m2=known.structure.tolist(),
        noise_m2=known.noise.tolist(),
        largest_m=known.largest_m,
        rows=known.rows,
        frame_m2=known.frame.tolist(),
        circumstances=dict(known.circumstances),
        absent=[StoredTerm(effect=t.name, where=t.where, form=t.placement) for t in known.absent],
        domain=None if known.domain is None else _store_domain(known.domain),
        alternatives=[_store_alternative(a, held, model.arm) for a in known.alternatives],
    )


def restore_uncertainty(
    given: StoredUncertainty | None, model: Model, where: str
) -> ModelUncertainty | None:
    """Return a model's uncertainty from its stored form.

    Raises:
        InputError: it does not belong to the model, or a value is no covariance or no number.
    """
    if given is None:
        return None
    absent = [restore_term(entry, model.arm, where) for entry in given.absent]
    possible = possible_compliances(model.arm, {term.key for term in model.terms})
    if [term for term in possible if term in absent] != absent:
        wrong = next((f"{t.name}, {t.where}" for t in absent if t not in possible), "another order")
        allowed = "parts of the arm that may yield and the model does not hold, each once, in order"
        raise InputError(where, "uncertainty.absent", wrong, allowed)
    slots = (*model.slots, *slots_of(model.arm, absent))
    if len(given.factor) != len(slots):
        allowed = f"{len(slots)}, one a parameter"
        raise InputError(where, "uncertainty.factor", f"{len(given.factor)} lines", allowed)
    try:
        factor = decode_triangle(given.factor)
    except ValueError as error:
        allowed = "base 64 of as many 32-bit numbers as its number"
        raise InputError(where, "uncertainty.factor", str(error), allowed) from None
    names = ("structure_m2", "noise_m2", "frame_m2")
    squares = {name: np.array(getattr(given, name)) for name in names}
    for name, square in squares.items():
        least, size = np.linalg.eigvalsh(square).min(), np.abs(square).max()
        if least < -1e-9 * size or not np.allclose(square, square.T, atol=1e-9 * size):
            raise InputError(where, f"uncertainty.{name}", "no covariance", "a covariance, m^2")
    for name, (low, high) in given.circumstances.items():
        if not low <= high:
            raise InputError(where, f"uncertainty.circumstances.{name}", [low, high], "low, high")
    return ModelUncertainty(
        tuple(slot.identity for slot in slots),
        factor,
        squares["structure_m2"],
        squares["noise_m2"],
        given.largest_m,
        given.rows,
        squares["frame_m2"],
        given.circumstances,
        tuple(term for term in possible if term in absent),
        _restore_domain(given.domain, model, where),
        tuple(_restore_alternative(each, model, where) for each in given.alternatives),
    )


def _store_domain(known: RowDomain) -> StoredDomain:
    span = np.where(np.isfinite(known.span), known.span, 0.0)
    places = [encode_numbers(q) for q in known.q.T]
    return StoredDomain(places=places, span=span.tolist(), amid=known.amid)


def _restore_domain(given: StoredDomain | None, model: Model, where: str) -> RowDomain | None:
    """Return where the rows stood; None for a file of an earlier version, which does not say it."""
    if given is None:
        return None
    n, q = model.arm.n, _decode_lines(given.places).T
    if q.ndim != 2 or not len(q) or q.shape[1] != n or len(given.span) != n:
        allowed = f"a line and a range for each of {n} joints, base 64 of as many 32-bit numbers"
        raise InputError(where, "uncertainty.domain", f"{len(given.places)} lines", allowed)
    span = np.array(given.span)
    return RowDomain(q, np.where(span > 0.0, span, np.inf), given.amid)


def _decode_lines(lines: list[str]) -> np.ndarray:
    """Return the numbers of lines of equal length, (K, k), or (0, 0) if a line holds none."""
    try:
        return np.array([decode_numbers(line) for line in lines])
    except ValueError:
        return np.zeros((0, 0))


def _store_alternative(
    other: Alternative, held: list[tuple[object, ...]], arm: Arm
) -> StoredAlternative:
    """Return the stored form of an alternative of a model with the parameters `held`."""
    order = [*held, *(slot.identity for slot in slots_of(arm, other.terms))]
    return StoredAlternative(
        chance=other.chance,
        terms=[store_term(t, arm) for t in other.terms],
        moves=[encode_numbers(move) for move in other.moves_of(order)],
    )


def _restore_alternative(given: StoredAlternative, model: Model, where: str) -> Alternative:
    terms = tuple(restore_term(entry, model.arm, where) for entry in given.terms)
    slots = (*model.slots, *slots_of(model.arm, terms))
    moves = _decode_lines(given.moves)
    if moves.ndim != 2 or moves.shape[1] != len(slots):
        allowed = f"lines of base 64 of {len(slots)} 32-bit numbers, one a parameter"
        raise InputError(where, "uncertainty.alternatives", f"{len(given.moves)} lines", allowed)
    effects = tuple(t for t in terms if isinstance(t, Effect))
    return Alternative(given.chance, tuple(slot.identity for slot in slots), moves, effects)
