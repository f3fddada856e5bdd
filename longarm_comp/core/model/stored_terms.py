"""Terms of a model as `model.yaml` holds them: name, place, form, values, origin."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import get_type_hints

from pydantic import Field, model_validator

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.catalogue import effect_class
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.errors import InputError
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
