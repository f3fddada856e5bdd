"""Converts a table of another program to a session's CSV, with the mapping beside it."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_paths
from longarm_comp.sessions.csv import LABELS, XYZ
from longarm_comp.sessions.foreign.cells import Cells, read_cells
from longarm_comp.sessions.foreign.columns import JOINT, Column, kind_of, turned, understand
from longarm_comp.sessions.foreign.combine import (
    appended,
    beside_each_other,
    joined,
    melted,
    ordered,
)
from longarm_comp.sessions.foreign.conventions import Conventions, conventions
from longarm_comp.sessions.foreign.poses import Found, found_in, of_marker, unit_in
from longarm_comp.sessions.foreign.units import (
    ALLOWED,
    ANGLE,
    UNIT_LENGTH,
    UNITS,
    Rotation,
    Unit,
    seconds,
    split_name,
)
from longarm_comp.sessions.foreign.written import Like
from longarm_comp.sessions.table import fill_table
from longarm_comp.sessions.targets import QUATERNION

_MAY_BE_BLANK = re.compile(
    r"[xyz]|distance|repeat_id|approach|ray_[xyz]|sigma_rot|q[xyzw]|read_q\d+"
)


@dataclass(frozen=True)
class Options:
    """What the user says of a file.

    Attributes:
        units: of columns that name none, such as ``mm`` and ``deg``.
        given, arm: see `understand`.
        rotation: ``CONVENTION:COLUMNS``, ``none`` to leave an orientation out, or nothing.
        sheet, decimal, columns: see `read_cells`.
        join: column that says which rows of several files belong together; None: they follow.
        sort: column in whose order the rows were measured; None: in the file's.
    """

    units: tuple[str, ...] = ()
    given: Mapping[str, str] = field(default_factory=dict)
    rotation: str | None = None
    sheet: str | None = None
    decimal: str | None = None
    arm: Arm | None = None
    join: str | None = None
    sort: str | None = None
    columns: tuple[str, ...] = ()

    def like(self, mapping: Path) -> Options:
        """With what an earlier mapping says beside; what is told here goes before it."""
        form = Like(mapping)
        told = {name.partition(":")[0] for name in self.given.values()}
        kept = {
            source: f"{name}:{unit.name}" if unit else name
            for name, (source, unit) in form.columns.items()
            if name not in told
        }
        return replace(
            self,
            units=self.units or form.units,
            given={**kept, **self.given},
            rotation=self.rotation or form.rotation,
            columns=self.columns or form.names,
            decimal=self.decimal or form.decimal,
        )


@dataclass(frozen=True)
class _Imported:
    cells: Cells
    columns: Mapping[str, np.ndarray]
    """Session columns by name, (N,) numbers or texts; `sources`: how each was read."""
    sources: tuple[Column, ...]
    left_out: tuple[str, ...]  # columns of the file that were not read
    assumed: tuple[str, ...]  # joints that were taken to turn, as no arm says it
    rotation: Rotation | None
    options: Options
    files: tuple[Path, ...] = ()
    joined: tuple[str, ...] = ()  # how near the rows of joined files are, and which have no partner
    markers: tuple[str, ...] = ()  # that stood side by side

    def preview(self) -> list[dict[str, Any]]:
        """One row a column: what it was read from, in which unit, and its range."""
        rows = []
        for column in self.sources:
            values = self.columns[column.name]
            numeric = values.dtype.kind == "f" and not np.isnan(values).all()
            unit = column.unit.name if column.unit else ""
            row: dict[str, Any] = {"column": column.name, "from": column.source, "unit": unit}
            row["first"] = values[0] if numeric else str(values[0])
            row["min"], row["max"] = (
                float(end(values)) if numeric else None for end in (np.nanmin, np.nanmax)
            )
            row["blank"] = int(np.isnan(values).sum()) if values.dtype.kind == "f" else 0
            rows.append(row)
        return rows

    def save(self, path: Path) -> Path:
        """Write the session and the mapping beside it, both or none; returns the mapping's path."""
        beside = path.with_suffix(".mapping.yaml")
        with atomic_paths(path, beside) as (session, mapping):
            fill_table(session, list(self.columns), zip(*self.columns.values(), strict=True))
            mapping.write_text(self._mapping(session), encoding="utf-8", newline="\n")
        return beside

    def _mapping(self, session: Path) -> str:
        """Text of the mapping of a session that is written."""
        several = len(self.files) > 1  # each may have its own sign
        names = ", ".join(file.name for file in self.files)
        hashes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in self.files]
        mapping = {
            "source": names,
            "source_sha256": ", ".join(hashes),
            "session_sha256": hashlib.sha256(session.read_bytes()).hexdigest(),
            "separator": self.cells.separator,
            "decimal": self.cells.decimal if self.cells.separator and not several else None,
            "header_lines": list(self.cells.header_lines),
            "rows": len(self.cells.rows),
            "units": list(self.options.units),
            "columns": {
                c.name: {"from": c.source, **({"unit": c.unit.name} if c.unit else {})}
                for c in self.sources
            },
            "left_out": list(self.left_out),
        }
        if self.rotation is not None:
            mapping["rotation"] = f"{self.rotation.spelt}:{','.join(self.rotation.columns)}"
        elif self.options.rotation is not None:
            mapping["rotation"] = self.options.rotation
        if self.options.columns:
            mapping["names"] = list(self.options.columns)
        text = yaml.safe_dump(mapping, sort_keys=False, allow_unicode=True, width=100)
        return f"# How longarm import-data read {names}.\n{text}"


def import_table(path: str | Path | Sequence[str | Path], options: Options) -> _Imported:
    """Read a table of another program, or several that make one session."""
    files = tuple(map(Path, [path] if isinstance(path, str | Path) else path))
    cells, said = _together(files, options)
    where = cells.where
    markers = beside_each_other(cells, options.given)
    if markers:
        cells = melted(cells, markers, options.rotation != "none")
    found = _poses(cells, options)
    defaults = _defaults(where, options.units)
    turned_by = {cells.names[k] for each in found if each.turn for k in each.places}
    told = _told_rotation(cells, options)
    apart = turned_by.union(() if told is None else told.columns)
    axes = {
        k: a for each in found if not each.turn for k, a in zip(each.places, "xyz", strict=True)
    }
    sources = understand(cells, options.given, defaults, options.arm, apart, axes)
    _complete(where, cells, sources, options.arm, bool(apart))
    columns: dict[str, np.ndarray] = {c.name: _values(cells, c) for c in sources}
    if cells.index and "index" not in columns:
        columns = {"index": np.array(cells.index), **columns}
    rotation = told or _rotation(cells, options, found, {c.place for c in sources})
    if rotation is not None:
        values = _parts(cells, rotation, defaults)
        columns |= _orientation(where, rotation, values, _fitting(columns, values, options))
    read = {c.source for c in sources}.union(() if rotation is None else rotation.columns)
    left = tuple(n or f"column {k + 1}" for k, n in enumerate(cells.names) if n not in read)
    assumed = tuple(
        c.name
        for c in sources
        if kind_of(c.name, options.arm) == JOINT and split_name(c.source)[1] is None
        and ":" not in options.given.get(c.source, "")
    )  # fmt: skip
    return _Imported(
        cells, columns, tuple(sources), left, assumed, rotation, options, files, said, markers
    )


def _together(files: tuple[Path, ...], options: Options) -> tuple[Cells, tuple[str, ...]]:
    """The table of all files, and how their rows belong together."""
    tables = [read_cells(file, options.sheet, options.decimal, options.columns) for file in files]
    cells = tables[0]
    said: tuple[str, ...] = ()
    if options.join is not None:
        if len(tables) == 1:
            raise InputError(cells.where, "--join", options.join, "two files or more")
        cells, said = joined(tables, options.join)
    elif len(tables) > 1:
        cells = appended(tables)
    return cells if options.sort is None else ordered(cells, options.sort), said


def _poses(cells: Cells, options: Options) -> list[Found]:
    """Positions and orientations whose names are no joints and not told by the user.

    Of ``q0`` to ``q3``, where their length is 1: numbers of joints have no such.
    """
    known = () if options.arm is None else options.arm.joint_names
    apart = [
        k
        for k, name in enumerate(cells.names)
        if {name, split_name(name)[0]} & {*options.given, *known}
    ]
    found = found_in(cells.names, apart)
    return [each for each in found if "3" not in each.form.parts or _of_length_1(cells, each)]


def _of_length_1(cells: Cells, found: Found) -> bool:
    numbers = [[cells.number(t) for t in cells.column(k)] for k in found.places]
    values = np.array(numbers, dtype=float)
    length = np.linalg.norm(values[:, np.isfinite(values).all(axis=0)], axis=0)
    return bool(len(length) and (np.abs(length - 1) < UNIT_LENGTH).all())


def _defaults(where: str, names: tuple[str, ...]) -> dict[str, Unit]:
    made: dict[str, Unit] = {}
    for name in names:
        if name not in UNITS or UNITS[name].kind in made:
            allowed = f"one of a kind of {', '.join(UNITS)}"
            raise InputError(where, "--units", name, allowed)
        made[UNITS[name].kind] = UNITS[name]
    return made


def _told_rotation(cells: Cells, options: Options) -> Rotation | None:
    """The orientation that the user says; None where none is said, or to read none."""
    if options.rotation in (None, "none"):
        return None
    rotation = Rotation.parse(options.rotation, cells.where)
    places = (cells.place(name, "--rotation") for name in rotation.columns)
    return replace(rotation, columns=tuple(cells.names[place] for place in places))


def _rotation(
    cells: Cells, options: Options, found: list[Found], read: Collection[int]
) -> Rotation | None:
    """The orientation of the marker whose position is read, in the convention that its names say;
    without one where they say none, or where columns look like an orientation but are not whole."""
    if options.rotation is not None:
        return None
    turns = of_marker(found, read)
    known = [each for each in turns if each.form.convention]
    alike = [each for each in known if each.form == known[0].form]
    if len(alike) == 1:
        columns = tuple(cells.names[k] for k in known[0].places)
        return Rotation(known[0].form.convention, columns)
    whole = {k for each in found for k in each.places if each.turn}
    looks = [
        k for k, name in enumerate(cells.names) if k not in whole and k not in read and turned(name)
    ]
    asked = [k for each in alike or turns[:1] for k in each.places] or looks
    return Rotation("", tuple(cells.names[k] for k in asked)) if len(asked) >= 3 else None


def _complete(
    where: str, cells: Cells, sources: list[Column], arm: Arm | None, turned: bool
) -> None:
    names = [c.name for c in sources]
    joints = sorted(int(n[1:]) for n in names if n[:1] == "q" and n[1:].isdigit())
    wanted = list(range(1, (arm.n if arm else len(joints)) + 1))
    if not joints or joints != wanted:
        found = ", ".join(f"q{j}" for j in joints) or "none"
        hint = f"q1..q{len(wanted)}" if wanted else "q1..qn"
        allowed = f"{hint}; name them with --map COLUMN=q1,... (columns: {', '.join(cells.names)})"
        raise InputError(where, "joints", found, allowed)
    if not turned and not {*XYZ, "distance", "ray_x", "touch", "plane"} & set(names):
        allowed = f"x, y, z; name them with --map COLUMN=x,... (columns: {', '.join(cells.names)})"
        raise InputError(where, "measurement", "none", allowed)


def _values(cells: Cells, column: Column) -> np.ndarray:
    texts = cells.column(column.place)
    if column.name in LABELS:
        return np.array(texts)
    clock = seconds(texts) if column.name == "t_s" else None
    if clock is not None:
        return clock
    power = 2 if column.name.startswith("cov_") else 1
    unit = column.unit
    values = _numbers(cells, column.place, bool(_MAY_BE_BLANK.fullmatch(column.name)))
    return values if unit is None else values * unit.factor**power + unit.offset


def _numbers(cells: Cells, place: int, blanks: bool) -> np.ndarray:
    values = np.empty(len(cells.rows))
    for k, (line, row) in enumerate(cells.rows):
        number = cells.number(row[place])
        if number is None and not (blanks and cells.empty(row[place])):
            sign = "comma" if cells.decimal == "," else "point"
            allowed = f"a number with a decimal {sign}" + (", or blank" if blanks else "")
            field = f"line {line}, {cells.names[place]}"
            raise InputError(cells.where, field, row[place], allowed)
        values[k] = np.nan if number is None else number
    return values


def _parts(cells: Cells, rotation: Rotation, defaults: Mapping[str, Unit]) -> np.ndarray:
    """(N, k) numbers of an orientation's columns, angles in rad; NaN without a unit."""
    read = []
    for name in rotation.columns:
        values = _numbers(cells, cells.names.index(name), True)
        if rotation.angles:
            unit = unit_in(name) or defaults.get(ANGLE)
            if rotation.convention and (unit is None or unit.kind != ANGLE):
                field = f"column {name}"
                raise InputError(cells.where, field, "no angle's unit", "--units deg or rad")
            values = values * (unit.factor if unit else math.nan)
        read.append(values)
    return np.stack(read, axis=-1)


def _fitting(
    columns: Mapping[str, np.ndarray], values: np.ndarray, options: Options
) -> Conventions | None:
    """How well each convention fits the rows; None where no arm or too few rows are known."""
    if options.arm is None:
        return None
    q = np.stack([columns[f"q{j + 1}"] for j in range(options.arm.n)], axis=-1)
    xyz = np.stack([columns.get(axis, np.full(len(q), np.nan)) for axis in XYZ], axis=-1)
    labels = {name: columns[name] for name in ("group", "marker") if name in columns}
    return conventions(options.arm, q, xyz, labels, values)


def _orientation(
    where: str, rotation: Rotation, values: np.ndarray, fitting: Conventions | None
) -> dict[str, np.ndarray]:
    """Columns of the quaternion.

    Raises:
        InputError: its convention is not known, or clearly another than that which the rows fit.
    """
    listed = ",".join(rotation.columns)
    if not rotation.convention:
        said = f"{fitting.said(listed)}; " if fitting else ""
        missing = f"missing for {', '.join(rotation.columns)}"
        raise InputError(where, "--rotation", missing, f"{said}{ALLOWED}; or none")
    if fitting and fitting.refutes(rotation):
        raise InputError(where, "--rotation", f"{rotation.spelt}:{listed}", fitting.said(listed))
    try:
        made = rotation.quaternions(values)
    except ValueError as error:
        raise InputError(where, "--rotation", str(error), "one rotation a row") from None
    return dict(zip(QUATERNION, made.T, strict=True))
