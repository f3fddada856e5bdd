"""Converts a table of another program to a session's CSV, with the mapping beside it."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_paths, file_hash
from longarm_comp.sessions.csv import LABELS, XYZ
from longarm_comp.sessions.foreign.cells import Cells, read_cells
from longarm_comp.sessions.foreign.columns import (
    JOINT,
    Column,
    find_columns,
    kind_of,
    looks_like_orientation,
)
from longarm_comp.sessions.foreign.combine import (
    append_tables,
    find_marker_headings,
    join_tables,
    melt_markers,
    sort_rows,
)
from longarm_comp.sessions.foreign.conventions import try_conventions
from longarm_comp.sessions.foreign.poses import (
    Found,
    find_forms,
    find_orientations,
    read_rotation,
)
from longarm_comp.sessions.foreign.units import (
    ALLOWED,
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
    """The user's options for reading a file.

    Attributes:
        units: units of columns that state none, such as ``mm`` and ``deg``.
        given, arm: see `find_columns`.
        rotation: ``CONVENTION:COLUMNS``; ``none`` to leave an orientation out; None to find it.
        sheet, decimal, columns: see `read_cells`.
        join: column that tells which rows of several files belong together; None: the files are
            appended.
        sort: column by which to sort the rows; None: they stay in the file's order.
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
        """Return these options, completed from an earlier mapping; those set here have priority."""
        form = Like(mapping)
        own = {name.partition(":")[0] for name in self.given.values()}
        kept = {
            source: f"{name}:{unit.name}" if unit else name
            for name, (source, unit) in form.columns.items()
            if name not in own
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
    assumed: tuple[str, ...]  # joints that were assumed to be revolute, because no arm tells it
    rotation: Rotation | None
    options: Options
    files: tuple[Path, ...] = ()
    joined: tuple[str, ...] = ()  # how near the rows of joined files are, and which have no partner
    markers: tuple[str, ...] = ()  # that stood side by side

    def preview(self) -> list[dict[str, Any]]:
        """Return one row for each column: what it was read from, its unit, and its range."""
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
        several = len(self.files) > 1  # each may have its own sign
        names = ", ".join(file.name for file in self.files)
        mapping: dict[str, Any] = {
            "source": names,
            "source_sha256": ", ".join(map(file_hash, self.files)),
            "session_sha256": "",
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
        with atomic_paths(path, beside) as (session, written):
            fill_table(session, list(self.columns), zip(*self.columns.values(), strict=True))
            mapping["session_sha256"] = file_hash(session)
            text = yaml.safe_dump(mapping, sort_keys=False, allow_unicode=True, width=100)
            text = f"# How longarm import-data read {names}.\n{text}"
            written.write_text(text, encoding="utf-8", newline="\n")
        return beside


def import_table(path: str | Path | Sequence[str | Path], options: Options) -> _Imported:
    """Read a table of another program, or several that make one session.

    Raises InputError if a file, an option or a cell is wrong, or joints or measurements are
    missing.
    """
    files = tuple(map(Path, [path] if isinstance(path, str | Path) else path))
    tables = [read_cells(file, options.sheet, options.decimal, options.columns) for file in files]
    cells, arm = tables[0], options.arm
    partners: tuple[str, ...] = ()
    if options.join is not None:
        if len(tables) == 1:
            raise InputError(cells.where, "--join", options.join, "two files or more")
        cells, partners = join_tables(tables, options.join)
    elif len(tables) > 1:
        cells = append_tables(tables)
    if options.sort is not None:
        cells = sort_rows(cells, options.sort)
    where = cells.where
    markers = find_marker_headings(cells, options.given)
    if markers:
        cells = melt_markers(cells, markers, options.rotation != "none")
    found = _find_poses(cells, options)
    defaults: dict[str, Unit] = {}
    for name in options.units:
        if name not in UNITS or UNITS[name].kind in defaults:
            raise InputError(where, "--units", name, f"one of a kind of {', '.join(UNITS)}")
        defaults[UNITS[name].kind] = UNITS[name]
    apart = {cells.names[k] for each in found if each.turn for k in each.places}
    rotation = None
    if options.rotation not in (None, "none"):
        rotation = Rotation.parse(options.rotation, where)
        places = (cells.place(name, "--rotation") for name in rotation.columns)
        rotation = replace(rotation, columns=tuple(cells.names[place] for place in places))
        apart.update(rotation.columns)
    positions = (each.places for each in found if not each.turn)
    axes = {k: axis for places in positions for k, axis in zip(places, "xyz", strict=True)}
    sources = find_columns(cells, options.given, defaults, arm, apart, axes)
    _check_complete(cells, [c.name for c in sources], arm, bool(apart))
    columns: dict[str, np.ndarray] = {c.name: _read_column(cells, c) for c in sources}
    if cells.index and "index" not in columns:
        columns = {"index": np.array(cells.index), **columns}
    if options.rotation is None:
        rotation = _find_rotation(cells, found, {c.place for c in sources})
    if rotation is not None:
        columns |= _read_orientation(cells, rotation, columns, defaults, arm)
    read = {c.source for c in sources}.union(() if rotation is None else rotation.columns)
    left = tuple(n or f"column {k + 1}" for k, n in enumerate(cells.names) if n not in read)
    assumed = tuple(
        c.name
        for c in sources
        if kind_of(c.name, arm) == JOINT
        and split_name(c.source)[1] is None
        and ":" not in options.given.get(c.source, "")
    )
    return _Imported(
        cells, columns, tuple(sources), left, assumed, rotation, options, files, partners, markers
    )


def _find_poses(cells: Cells, options: Options) -> list[Found]:
    """Find the positions and orientations; columns of joints, or mapped by the user, do not count.

    Columns such as ``q0`` to ``q3`` are a quaternion only if its length is 1 in all complete rows:
    they may be joints.
    """
    known = {*options.given, *(() if options.arm is None else options.arm.joint_names)}
    names = enumerate(cells.names)
    found = find_forms(cells.names, [k for k, n in names if known & {n, split_name(n)[0]}])
    poses = []
    for each in found:
        if "3" in each.form.parts:
            numbers = [[cells.number(text) for text in cells.column(k)] for k in each.places]
            values = np.array(numbers, dtype=float)
            length = np.linalg.norm(values[:, np.isfinite(values).all(axis=0)], axis=0)
            if not len(length) or (np.abs(length - 1) >= UNIT_LENGTH).any():
                continue
        poses.append(each)
    return poses


def _find_rotation(cells: Cells, found: list[Found], read: Collection[int]) -> Rotation | None:
    """Find the orientation of the marker whose position is in the columns `read` (indices).

    Its convention is the one that the names of its columns tell. It is empty if the names tell
    none, if several orientations come into question, or if columns only look like an orientation.
    """
    turns = find_orientations(found, read)
    known = [each for each in turns if each.form.convention]
    alike = [each for each in known if each.form == known[0].form]
    if len(alike) == 1:
        columns = tuple(cells.names[k] for k in known[0].places)
        return Rotation(known[0].form.convention, columns)
    whole = {k for each in found for k in each.places if each.turn}
    others = [k for k in range(len(cells.names)) if k not in whole and k not in read]
    looks = [k for k in others if looks_like_orientation(cells.names[k])]
    asked = [k for each in alike or turns[:1] for k in each.places] or looks
    return Rotation("", tuple(cells.names[k] for k in asked)) if len(asked) >= 3 else None


def _check_complete(cells: Cells, names: Collection[str], arm: Arm | None, turned: bool) -> None:
    joints = sorted(int(n[1:]) for n in names if n[:1] == "q" and n[1:].isdigit())
    wanted = list(range(1, (arm.n if arm else len(joints)) + 1))
    there = f"(columns: {', '.join(cells.names)})"
    if not joints or joints != wanted:
        found = ", ".join(f"q{j}" for j in joints) or "none"
        hint = f"q1..q{len(wanted)}" if wanted else "q1..qn"
        allowed = f"{hint}; name them with --map COLUMN=q1,... {there}"
        raise InputError(cells.where, "joints", found, allowed)
    if not turned and not {*XYZ, "distance", "ray_x", "touch", "plane"} & set(names):
        allowed = f"x, y, z; name them with --map COLUMN=x,... {there}"
        raise InputError(cells.where, "measurement", "none", allowed)


def _read_column(cells: Cells, column: Column) -> np.ndarray:
    texts = cells.column(column.place)
    if column.name in LABELS:
        return np.array(texts)
    clock = seconds(texts, cells.breaks) if column.name == "t_s" else None
    if clock is not None:
        return clock
    values = cells.numbers(column.place, bool(_MAY_BE_BLANK.fullmatch(column.name)))
    power = 2 if column.name.startswith("cov_") else 1
    unit = column.unit
    return values if unit is None else values * unit.factor**power + unit.offset


def _read_orientation(
    cells: Cells,
    rotation: Rotation,
    columns: Mapping[str, np.ndarray],
    defaults: Mapping[str, Unit],
    arm: Arm | None,
) -> dict[str, np.ndarray]:
    """Return the columns of the quaternion, (N,) each.

    With the joints and positions in `columns`, an arm's model shows which convention fits. One that
    is not known, or that the rows clearly refute, is refused.
    """
    values = read_rotation(cells, rotation, defaults)
    fitting = None
    if arm is not None:
        q = np.stack([columns[f"q{j + 1}"] for j in range(arm.n)], axis=-1)
        xyz = np.stack([columns.get(axis, np.full(len(q), np.nan)) for axis in XYZ], axis=-1)
        labels = {name: columns[name] for name in ("group", "marker") if name in columns}
        fitting = try_conventions(arm, q, xyz, labels, values)
    listed = ",".join(rotation.columns)
    if not rotation.convention:
        best = f"{fitting.describe(listed)}; " if fitting else ""
        missing = f"missing for {', '.join(rotation.columns)}"
        raise InputError(cells.where, "--rotation", missing, f"{best}{ALLOWED}; or none")
    if fitting and fitting.refutes(rotation):
        given = f"{rotation.spelt}:{listed}"
        raise InputError(cells.where, "--rotation", given, fitting.describe(listed))
    try:
        made = rotation.quaternions(values)
    except ValueError as error:
        raise InputError(cells.where, "--rotation", str(error), "one rotation a row") from None
    return dict(zip(QUATERNION, made.T, strict=True))
