"""Reads and writes targets, plans and commands in the format of the user's own table.

Names, units and the kind of file are those of the table from which a session was imported.
"""

import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import write_bytes, write_text
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.sessions.csv import LABELS
from longarm_comp.sessions.foreign.cells import WORKBOOK, Cells, read_cells
from longarm_comp.sessions.foreign.poses import read_rotation
from longarm_comp.sessions.foreign.units import UNITS, Rotation, Unit, split_name
from longarm_comp.sessions.table import Table
from longarm_comp.sessions.targets import QUATERNION

_POINT = re.compile(r"(.+_)?([xyz])")
_JOINT = re.compile(r"(run_up_|ideal_)?(q\d+)")
_SIDE = re.compile(r"approach_(q\d+)")


class Like:
    """The format of a table, from the mapping that `longarm import-data` wrote.

    Attributes:
        columns: name in the table and unit, by session column.
        units, rotation, decimal: as in `convert.Options`.
        names: names of the columns, if the table itself has none.
        workbook: whether the table was a workbook.
    """

    def __init__(self, mapping: Path) -> None:
        data = read_yaml(mapping)
        try:
            self.columns = {
                str(name): (str(entry["from"]), UNITS[entry["unit"]] if "unit" in entry else None)
                for name, entry in data["columns"].items()
            }
            self.units, self.rotation = tuple(map(str, data["units"])), data.get("rotation")
            self.workbook = Path(str(data["source"])).suffix.lower() in WORKBOOK
            self.decimal = data["decimal"]
            self.names = tuple(map(str, data.get("names", ())))
            self._sign = str(self.decimal or ".")
            # As pandas writes it, where a pattern was read
            mark = str(data["separator"])
            mark = {r"\t": "\t", r"\|": "|"}.get(mark, mark)
            other = "\t" if mark else ";" if self._sign == "," else ","
            self._separator = mark if len(mark) == 1 and mark != self._sign else other
        except (TypeError, KeyError, AttributeError) as error:
            allowed = "a mapping that longarm import-data wrote"
            raise InputError(mapping, "columns", repr(error), allowed) from error

    def output(self, path: Path) -> Path:
        """Return the path with the ending of the table's kind."""
        return path.with_suffix(".xlsx") if self.workbook else path

    def read(self, path: str | Path) -> Table:
        """Read a table in this format and return it with session names, in SI units.

        Orientations become quaternions. Columns that the mapping does not know keep their names.

        Raises:
            InputError: the table cannot be read, or holds a part of an orientation.
        """
        cells = read_cells(Path(path))
        known = {s: (n, u) for n, (s, u) in self.columns.items()}
        known = {split_name(s)[0]: form for s, form in known.items()} | known
        turned, made = self._read_orientation(cells)
        for place, source in enumerate(cells.names):
            if source in turned:
                continue
            stem, stated = split_name(source)
            name, unit = known.get(source) or known.get(stem) or (source, None)
            unit, texts = stated or unit, cells.column(place)
            if unit is not None and name not in LABELS:
                numbers = [cells.number(text) for text in texts]
                texts = [
                    text if v is None else repr(v * unit.factor + unit.offset)
                    for text, v in zip(texts, numbers, strict=True)
                ]
            made[name] = texts
        return Table(str(path), tuple(made), tuple(line for line, _ in cells.rows), made)

    def _read_orientation(self, cells: Cells) -> tuple[tuple[str, ...], dict[str, list[str]]]:
        """Return the names of the columns of an orientation, and the columns of its quaternion.

        Both are empty if the table has none of the columns.
        """
        if self.rotation in (None, "none"):
            return (), {}
        rotation = Rotation.parse(str(self.rotation), cells.where)
        keys = [name if name in cells.names else split_name(name)[0] for name in rotation.columns]
        if not {*cells.names, *(split_name(name)[0] for name in cells.names)} & {*keys}:
            return (), {}
        names = tuple(cells.names[cells.place(key, "orientation")] for key in keys)
        defaults = {UNITS[name].kind: UNITS[name] for name in self.units if name in UNITS}
        values = read_rotation(cells, replace(rotation, columns=names), defaults)
        try:
            turns = rotation.quaternions(values).T
        except ValueError as error:
            raise InputError(cells.where, "orientation", str(error), "one rotation a row") from None
        texts = [["" if math.isnan(v) else repr(float(v)) for v in column] for column in turns]
        return names, dict(zip(QUATERNION, texts, strict=True))

    def write(self, path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Write rows, given in SI units, with the user's names and units.

        The path's ending decides between a workbook and text. The file is written whole or not at
        all.
        """
        import pandas as pd

        def convert(value: Any, unit: Unit | None, moved: bool) -> Any:
            if unit is None or value is None or value == "":
                return value
            return (float(value) - (unit.offset if moved else 0.0)) / unit.factor

        forms = [self._read_form(name) for name in header]
        cells = [
            [convert(value, *form[1:]) for value, form in zip(row, forms, strict=True)]
            for row in rows
        ]
        frame = pd.DataFrame(cells, columns=[name for name, _, _ in forms], dtype=object)
        frame = frame.infer_objects()  # numbers get the sign before decimals
        if Path(path).suffix.lower() in WORKBOOK:
            made = io.BytesIO()
            frame.to_excel(made, index=False, engine="openpyxl")
            write_bytes(path, made.getvalue())
        else:
            form = {"sep": self._separator, "decimal": self._sign, "lineterminator": "\n"}
            write_text(path, frame.to_csv(index=False, **form))

    def _read_form(self, name: str) -> tuple[str, Unit | None, bool]:
        """Return the user's name of a column, its unit, and whether the unit's offset applies."""
        joint, side, point = (p.fullmatch(name) for p in (_JOINT, _SIDE, _POINT))
        if side and side[1] in self.columns:
            return f"approach {split_name(self.columns[side[1]][0])[0]}", None, False
        if name in self.columns:
            source, unit = self.columns[name]
            return source, unit, True
        for found in (joint, point):
            if found and found[2] in self.columns:
                source, unit = self.columns[found[2]]
                stem, named = split_name(source)
                what = (found[1] or "").strip("_").replace("_", " ")
                bracket = f" [{unit.name}]" if unit and named else ""
                return f"{what} {stem}{bracket}".strip(), unit, False
        return name, None, False
