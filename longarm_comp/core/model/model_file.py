"""`model.yaml`: a calibrated model with units, intervals and the origin of every value.

A change gives a new version. The previous file is kept beside it (`file_versions`), and `undo`
restores it byte for byte.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_type_hints

import numpy as np
import yaml
from pydantic import Field, model_validator

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import CLOCK
from longarm_comp.core.arm.parts import Pose, Vec3
from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.core.effects.catalogue import effect_class, origin, possible_compliances
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.shapes import Function
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.file_versions import previous, replace_file, settle, write_version
from longarm_comp.core.model.model import Model, slots_of
from longarm_comp.core.model.uncertainty import (
    ModelUncertainty,
    decode_triangle,
    encode_triangle,
    triangular,
)
from longarm_comp.core.yaml_file import Declared, Misdeclared, parse_declared, read_yaml

_Square = tuple[Vec3, Vec3, Vec3]
_ZERO: _Square = ((0.0, 0.0, 0.0),) * 3

AS_DECLARED = 0
"""Version number of a file that holds the arm as declared, to which `undo` of the first change
returns."""


class _StoredValue(Declared):
    """One parameter: SI value, unit and 95 % interval."""

    value: float
    unit: str
    ci95: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> _StoredValue:
        if self.ci95 is not None and not self.ci95[0] <= self.ci95[1]:
            raise Misdeclared("ci95", list(self.ci95), "[lower, upper] with lower <= upper")
        return self


class _StoredTerm(Declared):
    """One effect or bias: canonical name, place, form, values, origin."""

    effect: str
    where: str
    form: dict[str, int | float | str] = Field(default_factory=dict)
    parameters: dict[str, _StoredValue] = Field(default_factory=dict)
    origin: str = ""


class _ArmReference(Declared):
    """The arm that a model belongs to."""

    name: str
    hash: str


class _StoredUncertainty(Declared):
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
    absent: list[_StoredTerm] = Field(
        default_factory=list, description="effects that are not held; parameters after the others"
    )


class StoredModel(Declared):
    """The contents of model.yaml.

    The last key, `schema`, is required and has one allowed value, so a truncated file is detected.
    """

    version: int = Field(ge=0)
    arm: _ArmReference
    passes: int = Field(ge=1, le=50)  # more change no digit and take minutes
    elements_per_beam: int = Field(ge=1, le=64)  # more change no digit
    geometry: list[_StoredTerm]
    effects: list[_StoredTerm]
    camera: list[_StoredTerm]
    provenance: dict[str, str | int | float]
    arrivals: tuple[tuple[int, int], ...]
    row_legs: tuple[Annotated[float, Field(ge=0.0)], ...] = Field(
        default=(),
        description="way of each joint since it turned that three of four fitted rows reach, "
        "rad or m: run-ups are as long",
    )
    placement: dict[str, Pose] = Field(
        description="where bases stand in the frame of the measurements: for people and other "
        "programs; `geometry` is what counts",
    )
    uncertainty: _StoredUncertainty | None
    ended_s: float | None = Field(
        default=None, description="where the clock of the session, its t_s, stood at the end"
    )
    frame_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    schema_: Literal["longarm/model/1"] = Field(alias="schema")


def store(
    model: Model,
    standard_errors: np.ndarray | None = None,
    *,
    version: int = 1,
    provenance: Mapping[str, str | int | float] | None = None,
    origins: Mapping[int, str] | None = None,
    intervals: Mapping[tuple[int, str], tuple[float, float]] | None = None,
) -> StoredModel:
    """Return the stored form of a model.

    Args:
        standard_errors: (p,) of the model's parameters, for normal 95 % intervals.
        version: version number of the file; `AS_DECLARED` for the arm as declared.
        provenance: session hash, date, verdict, seed, ...
        origins: the origin of a term, by its number in `Model.terms`.
        intervals: 95 % intervals that replace the normal ones, by (term number, parameter name).
    """
    ends = dict(intervals or {})
    if standard_errors is not None:
        for slot, se in zip(model.slots, standard_errors, strict=True):
            p, half = slot.parameter, 1.96 * float(se)
            normal = max(slot.value - half, p.lower), min(slot.value + half, p.upper)
            ends.setdefault((slot.term, p.name), normal)
    sides: dict[str, list[_StoredTerm]] = {"geometry": [], "effects": [], "camera": []}
    for number, term in enumerate(model.terms):
        if term.passing:
            continue
        parameters = {
            p.name: _StoredValue(
                value=float(getattr(term, p.name)), unit=p.unit, ci95=ends.get((number, p.name))
            )
            for p in term.parameters(model.arm)
        }
        side = "camera" if isinstance(term, Bias) else "geometry" if term.geometry else "effects"
        stored = _StoredTerm(
            effect=term.name,
            where=term.where,
            form=term.placement,
            parameters=parameters,
            origin=(origins or {}).get(number, ""),
        )
        sides[side].append(stored)
    arm = _ArmReference(name=model.arm.name, hash=model.arm.hash)
    # Effects from outside the package, which the user must provide again
    known = {f"{term.name}_from": origin(type(term)) for term in model.terms}
    outside = {name: source for name, source in known.items() if source}
    return StoredModel(
        schema="longarm/model/1",
        version=version,
        arm=arm,
        passes=model.passes,
        elements_per_beam=model.elements_per_beam,
        arrivals=model.arrivals,
        row_legs=model.row_legs,
        provenance={**(provenance or {}), **outside},
        placement=_base_poses(model),
        uncertainty=_store_uncertainty(model),
        ended_s=model.ended_s,
        frame_shift_m=model.frame_shift,
        **sides,
    )


def _store_uncertainty(model: Model) -> _StoredUncertainty | None:
    """Return the model's uncertainty, with parameters in the order in which `restore` has them."""
    known = model.uncertainty
    if known is None:
        return None
    kept = [t for t in model.terms if not t.passing]
    in_file = sorted(kept, key=lambda t: 2 if isinstance(t, Bias) else int(not t.geometry))
    order = [slot.identity for slot in slots_of(model.arm, [*in_file, *known.absent])]
    factor = np.zeros((len(order), known.factor.shape[1]))
    for k, identity in enumerate(order):
        if identity in known.row:
            factor[k] = known.factor[known.row[identity]]
    return _StoredUncertainty(
        factor=encode_triangle(triangular(factor)),
        structure_m2=known.structure.tolist(),
        noise_m2=known.noise.tolist(),
        largest_m=known.largest_m,
        rows=known.rows,
        frame_m2=known.frame.tolist(),
        circumstances=dict(known.circumstances),
        absent=[_StoredTerm(effect=t.name, where=t.where, form=t.placement) for t in known.absent],
    )


def _base_poses(model: Model) -> dict[str, Pose]:
    """Return the pose of every base, by its place, in the form of `base` in arm.yaml."""
    poses = {}
    for effect in model.effects:
        frame = effect.base(model.arm)
        if frame is not None:
            matrix = frame.matrix()
            x, y, z = (round(float(v), 7) for v in matrix[:3, 3])
            roll, pitch, yaw = (round(math.degrees(v), 6) for v in roll_pitch_yaw(matrix[:3, :3]))
            poses[effect.where] = Pose(xyz_m=(x, y, z), rpy_deg=(roll, pitch, yaw))
    return poses


def save_model(path: str | Path, stored: StoredModel) -> None:
    """Write a stored model to a file, atomically. An existing file becomes the previous version."""
    data = stored.model_dump(mode="json", by_alias=True)
    text = yaml.safe_dump(data, sort_keys=False, width=100)
    head = "Written by longarm; values in SI units. Geometry, effects and measuring-side biases."
    write_version(path, f"# {head}\n{text}".encode())


def undo(path: str | Path) -> None:
    """Restore the previous version, byte for byte.

    Raises:
        InputError: there is no previous version, or it is not valid.
    """
    settle(path)
    kept = previous(path)
    if not kept.is_file():
        raise InputError(str(path), "previous version", "missing", f"a file {kept.name}")
    read_stored(kept)
    replace_file(kept, path)


def read_stored(path: str | Path) -> StoredModel:
    """Return the file's contents, validated.

    Raises:
        InputError: the file cannot be read or is no YAML, or a key or value is not allowed.
    """
    return parse_declared(StoredModel, read_yaml(path), str(path))


def load_model(path: str | Path, arm: Arm) -> Model:
    """Return the model in a file.

    Raises:
        InputError: as `read_stored`; the file belongs to another arm; an unknown place or
            parameter; an effect that is not registered, with the file or package it is from.
    """
    return restore(read_stored(path), arm, str(path))


def restore(stored: StoredModel, arm: Arm, where: str) -> Model:
    """Return a model from its stored form.

    Args:
        where: the file, for error messages.

    Raises:
        InputError: the model belongs to another arm, an effect, place or parameter is not known, an
            effect is given twice, or a value is not allowed.
    """
    if stored.arm.hash != arm.hash:
        mine = f"the arm given: {arm.name} {arm.hash[:12]}"
        allowed = f"{mine} (calibrate again after editing arm.yaml)"
        raise InputError(where, "arm.hash", f"{stored.arm.name} {stored.arm.hash[:12]}", allowed)
    terms: list[Effect | Bias] = []
    held: set[tuple[str, ...]] = set()
    for entry in (*stored.geometry, *stored.effects, *stored.camera):
        known_from = str(stored.provenance.get(f"{entry.effect}_from", ""))
        term = _restore_term(entry, arm, where, known_from)
        same = (term.name, *map(str, term.placement.items()))
        if same in held:
            raise InputError(where, f"{term.name}, {term.where}", "twice", "each effect once")
        held.add(same)
        terms.append(term)
    counts = {"arrivals": len(stored.arrivals), "row_legs": len(stored.row_legs)}
    for name, count in counts.items():
        if count not in (0, arm.n):
            allowed = f"one entry for each of {arm.n} joints, or none"
            raise InputError(where, name, f"of {count} joints", allowed)
    ended_s = stored.ended_s
    if ended_s is None:  # functions of the session's clock may say when it ended
        factors = (f for term in terms for f in getattr(term, "of", Function()).factors)
        ended_s = max((f.high for f in factors if f.of == CLOCK), default=None)
    model = Model(
        arm,
        effects=tuple(t for t in terms if isinstance(t, Effect)),
        biases=tuple(t for t in terms if isinstance(t, Bias)),
        passes=stored.passes,
        elements_per_beam=stored.elements_per_beam,
        arrivals=stored.arrivals,
        row_legs=stored.row_legs,
        ended_s=ended_s,
        frame_shift=stored.frame_shift_m,
    )
    return dataclasses.replace(model, uncertainty=_restore_uncertainty(stored, model, where))


def _restore_term(entry: _StoredTerm, arm: Arm, where: str, known_from: str = "") -> Effect | Bias:
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


def _restore_uncertainty(stored: StoredModel, model: Model, where: str) -> ModelUncertainty | None:
    given = stored.uncertainty
    if given is None:
        return None
    absent = [_restore_term(entry, model.arm, where) for entry in given.absent]
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
    )


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
