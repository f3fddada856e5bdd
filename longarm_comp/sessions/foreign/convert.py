"""Converts a table of another program to a session's CSV, with the mapping beside it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
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
        sheet, decimal: see `read_cells`.
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
    units: tuple[str, ...]  # of columns that name none
    files: tuple[Path, ...] = ()
    lonely: tuple[str, ...] = ()  # rows of joined files without a partner, in words
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
            "units": list(self.units),
            "columns": {
                c.name: {"from": c.source, **({"unit": c.unit.name} if c.unit else {})}
                for c in self.sources
            },
            "left_out": list(self.left_out),
        }
        if self.rotation is not None:
            sign, columns = "-" if self.rotation.inverse else "", ",".join(self.rotation.columns)
            mapping["rotation"] = f"{sign}{self.rotation.convention}:{columns}"
        text = yaml.safe_dump(mapping, sort_keys=False, allow_unicode=True, width=100)
        return f"# How longarm import-data read {names}.\n{text}"


def import_table(path: str | Path | Sequence[str | Path], options: Options) -> _Imported:
    """Read a table of another program, or several that make one session."""
    files = tuple(map(Path, [path] if isinstance(path, str | Path) else path))
    cells, lonely = _together(files, options)
    where = cells.where
    markers = beside_each_other(cells, options.given)
    if markers:
        cells = melted(cells, markers)
    rotation = _rotation(where, cells, options)
    turned_by = () if rotation is None else rotation.columns
    defaults = _defaults(where, options.units)
    apart = (*turned_by, *_unit_quaternion(cells))
    sources = understand(cells, options.given, defaults, options.arm, apart)
    _complete(where, cells, sources, options.arm)
    columns: dict[str, np.ndarray] = {c.name: _values(cells, c) for c in sources}
    if cells.index and "index" not in columns:
        columns = {"index": np.array(cells.index), **columns}
    if rotation is not None:
        columns |= _orientation(cells, rotation, defaults)
    read = {c.place for c in sources} | {cells.names.index(n) for n in turned_by}
    left = tuple(n or f"column {k + 1}" for k, n in enumerate(cells.names) if k not in read)
    assumed = tuple(
        c.name
        for c in sources
        if kind_of(c.name, options.arm) == JOINT and split_name(c.source)[1] is None
        and ":" not in options.given.get(c.source, "")
    )  # fmt: skip
    return _Imported(
        cells, columns, tuple(sources), left, assumed, rotation, options.units, files, lonely,
        markers,
    )  # fmt: skip


def _together(files: tuple[Path, ...], options: Options) -> tuple[Cells, tuple[str, ...]]:
    """The table of all files, and which rows have no partner."""
    tables = [read_cells(file, options.sheet, options.decimal) for file in files]
    cells = tables[0]
    lonely: tuple[str, ...] = ()
    if options.join is not None:
        if len(tables) == 1:
            raise InputError(cells.where, "--join", options.join, "two files or more")
        cells, lonely = joined(tables, options.join)
    elif len(tables) > 1:
        cells = appended(tables)
    return cells if options.sort is None else ordered(cells, options.sort), lonely


def _unit_quaternion(cells: Cells) -> tuple[str, ...]:
    """Columns q0 to q3 that are one orientation: numbers of joints have no length of 1."""
    found = {re.sub(r"[^a-z0-9]", "", split_name(n)[0].lower()): n for n in cells.names}
    names = [found.get(f"q{k}", "") for k in range(4)]
    if not all(names):
        return ()
    numbers = [[cells.number(t) for t in cells.column(cells.names.index(n))] for n in names]
    values = np.array(numbers, dtype=float)
    length = np.linalg.norm(values[:, np.isfinite(values).all(axis=0)], axis=0)
    return tuple(names) if len(length) and (np.abs(length - 1) < UNIT_LENGTH).all() else ()


def _defaults(where: str, names: tuple[str, ...]) -> dict[str, Unit]:
    made: dict[str, Unit] = {}
    for name in names:
        if name not in UNITS or UNITS[name].kind in made:
            allowed = f"one of a kind of {', '.join(UNITS)}"
            raise InputError(where, "--units", name, allowed)
        made[UNITS[name].kind] = UNITS[name]
    return made


def _rotation(where: str, cells: Cells, options: Options) -> Rotation | None:
    """The orientation to read; columns that look like one need their convention."""
    if options.rotation is not None and options.rotation != "none":
        rotation = Rotation.parse(options.rotation, where)
        places = (cells.place(name, "--rotation") for name in rotation.columns)
        return replace(rotation, columns=tuple(cells.names[place] for place in places))
    told = {*options.given, *(name for name in QUATERNION if set(QUATERNION) <= set(cells.names))}
    known = _unit_quaternion(cells)
    looks = [n for n in cells.names if turned(n) or n in known]
    looks = [n for n in looks if n not in told and split_name(n)[0] not in told]
    if len(looks) >= 3 and options.rotation is None:
        missing = f"missing for {', '.join(looks)}"
        raise InputError(where, "--rotation", missing, f"{ALLOWED}; or none")
    return None


def _complete(where: str, cells: Cells, sources: list[Column], arm: Arm | None) -> None:
    names = [c.name for c in sources]
    joints = sorted(int(n[1:]) for n in names if n[:1] == "q" and n[1:].isdigit())
    wanted = list(range(1, (arm.n if arm else len(joints)) + 1))
    if not joints or joints != wanted:
        found = ", ".join(f"q{j}" for j in joints) or "none"
        hint = f"q1..q{len(wanted)}" if wanted else "q1..qn"
        allowed = f"{hint}; name them with --map COLUMN=q1,... (columns: {', '.join(cells.names)})"
        raise InputError(where, "joints", found, allowed)
    if not {*XYZ, "distance", "ray_x", "touch", "plane", *QUATERNION} & set(names):
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


def _orientation(
    cells: Cells, rotation: Rotation, defaults: Mapping[str, Unit]
) -> dict[str, np.ndarray]:
    read = []
    for name in rotation.columns:
        values = _numbers(cells, cells.names.index(name), True)
        if rotation.angles:
            unit = split_name(name)[1] or defaults.get(ANGLE)
            if unit is None or unit.kind != ANGLE:
                field = f"column {name}"
                raise InputError(cells.where, field, "no angle's unit", "--units deg or rad")
            values = values * unit.factor
        read.append(values)
    try:
        made = rotation.quaternions(np.stack(read, axis=-1))
    except ValueError as error:
        raise InputError(cells.where, "--rotation", str(error), "quaternions of length 1") from None
    return dict(zip(QUATERNION, made.T, strict=True))
