"""`model.yaml`: a calibrated model with units, intervals and the origin of every value.

A change gives a new version. The previous file is kept beside it, and `undo` restores it byte for
byte. An interruption loses neither. If the path is a symbolic link, both are beside the file that
it leads to.
"""

import dataclasses
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from pydantic import Field

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import CLOCK
from longarm_comp.core.arm.parts import Pose
from longarm_comp.core.arm.spatial import roll_pitch_yaw
from longarm_comp.core.effects.catalogue import origin
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.effects.shapes import Function
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import follow_link, write_bytes
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.stored_parts import (
    StoredTerm,
    StoredUncertainty,
    restore_term,
    restore_uncertainty,
    store_term,
    store_uncertainty,
)
from longarm_comp.core.yaml_file import Declared, parse_declared, read_yaml


def write_version(path: str | Path, content: bytes) -> None:
    """Write a model file's bytes atomically. An existing file becomes the previous version.

    It is first copied to a third file, so that an interruption at any point loses no version.
    """
    path = Path(path)
    settle(path)
    if os.path.isfile(path):  # False in an unreadable folder; writing then raises
        write_bytes(_beside(path, "before"), path.read_bytes())
    write_bytes(path, content)
    settle(path)


def settle(path: str | Path) -> None:
    """Finish a `write_version` that was interrupted.

    The file that it had kept becomes the previous version, or is removed if nothing was replaced.
    """
    path = Path(path)
    kept = _beside(path, "before")
    if not os.path.isfile(kept):
        return
    if os.path.isfile(path) and path.read_bytes() == kept.read_bytes():  # nothing was replaced
        kept.unlink()
    else:
        replace_file(kept, previous(path))


def previous(path: str | Path) -> Path:
    """Return the path of the previous version. Raises InputError where the path names no file."""
    return _beside(path, "previous")


def _beside(path: str | Path, what: str) -> Path:
    path = follow_link(path)
    if not path.name:
        raise InputError(str(path), "model", "a folder", "a file")
    return path.with_name(f"{path.stem}.{what}{path.suffix}")


def replace_file(path: Path, to: str | Path) -> None:
    """Move a file to the place of another. Raises InputError if it may not be replaced."""
    try:
        os.replace(path, follow_link(to))
    except OSError as error:
        raise InputError(str(to), "file", error.strerror, "a file that may be replaced") from error


AS_DECLARED = 0
"""Version number of a file that holds the arm as declared, to which `undo` of the first change
returns."""


class _ArmReference(Declared):
    """The arm that a model belongs to."""

    name: str
    hash: str


class StoredModel(Declared):
    """The contents of model.yaml.

    The last key, `schema`, is required and has one allowed value, so a truncated file is detected.
    """

    version: int = Field(ge=0)
    arm: _ArmReference
    passes: int = Field(ge=1, le=50)  # more change no digit and take minutes
    elements_per_beam: int = Field(ge=1, le=64)  # more change no digit
    geometry: list[StoredTerm]
    effects: list[StoredTerm]
    camera: list[StoredTerm]
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
    uncertainty: StoredUncertainty | None
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
    sides: dict[str, list[StoredTerm]] = {"geometry": [], "effects": [], "camera": []}
    for number, term in enumerate(model.terms):
        if term.passing:
            continue
        side = "camera" if isinstance(term, Bias) else "geometry" if term.geometry else "effects"
        of_term = {name: end for (k, name), end in ends.items() if k == number}
        origin_of_term = (origins or {}).get(number, "")
        sides[side].append(store_term(term, model.arm, of_term, origin_of_term))
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
        uncertainty=store_uncertainty(model),
        ended_s=model.ended_s,
        frame_shift_m=model.frame_shift,
        **sides,
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
        term = restore_term(entry, arm, where, known_from)
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
    return dataclasses.replace(
        model, uncertainty=restore_uncertainty(stored.uncertainty, model, where)
    )
