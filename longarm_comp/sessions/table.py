"""Reads CSV files as columns of text, with line numbers for error messages; writes CSV files."""

import csv
import math
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path, check_regular, check_size
from longarm_comp.core.yaml_file import RANGES
from longarm_comp.sessions.foreign.units import split_name

FARTHEST = RANGES["_m"][1]
"""Largest allowed size of a joint value (rad, m) and of a coordinate (m)."""


Test = Callable[[float], bool]

MOST_CELLS = 20_000_000
"""Largest number of cells of a table; as text they take about 2 GB."""


def check_cells(path: str | Path, cells: int) -> None:
    """Raise InputError if a table has more than `MOST_CELLS` cells."""
    if cells > MOST_CELLS:
        raise InputError(path, "cells", f"more than {MOST_CELLS}", "a smaller table: split it")


@dataclass(frozen=True)
class Table:
    """Cells of a CSV file as text.

    Attributes:
        where: name of the file for error messages.
        header: names of the columns.
        lines: (N,) line number in the file of each row.
        cells: the N texts of each column, by its name.
    """

    where: str
    header: tuple[str, ...]
    lines: tuple[int, ...]
    cells: dict[str, list[str]]

    def __len__(self) -> int:
        return len(self.lines)

    def error(self, row: int | np.integer, column: str, allowed: str) -> InputError:
        value = self.cells[column][row]
        return InputError(self.where, f"line {self.lines[row]}, {column}", value, allowed)

    def blank(self, column: str) -> np.ndarray:
        """Tell (N,) whether a cell is empty; all True if there is no such column."""
        if column not in self.cells:
            return np.ones(len(self), dtype=bool)
        return np.array([not cell for cell in self.cells[column]])

    def numbers(
        self, column: str, unit: str, blanks: bool = False, test: Test | None = None
    ) -> np.ndarray:
        """Return the (N,) numbers of a column; an empty cell is NaN if `blanks` are allowed.

        Raises:
            InputError: a cell holds no finite number, or one that fails the `test`.
        """
        allowed = f"a finite number ({unit})" + (", or blank" if blanks else "")
        values = np.empty(len(self))
        for row, cell in enumerate(self.cells[column]):
            if not cell and blanks:
                values[row] = math.nan
                continue
            try:
                values[row] = _read_number(cell)
            except ValueError:
                raise self.error(row, column, allowed) from None
            # Larger numbers are no measurement; their squares leave the range of numbers
            if not abs(values[row]) <= 1e30 or (test is not None and not test(values[row])):
                raise self.error(row, column, allowed)
        return values

    def block(
        self, columns: Sequence[str], unit: str, blanks: bool = False, test: Test | None = None
    ) -> np.ndarray:
        """Return the (N, k) numbers of k columns; InputError if one of them is missing."""
        check_header(self.where, self.header, columns)
        return np.stack([self.numbers(name, unit, blanks, test) for name in columns], axis=-1)

    def has(self, columns: Collection[str]) -> bool:
        """Tell whether any of these columns is there."""
        return not set(columns).isdisjoint(self.cells)

    def lengths(self, columns: Sequence[str], unit: str = "m", blanks: bool = False) -> np.ndarray:
        """Return (N, k) coordinates or joints as `block` does; none may exceed `FARTHEST`."""
        unit = f"{unit}, up to {FARTHEST:g}"
        return self.block(columns, unit, blanks, lambda v: abs(v) <= FARTHEST)

    def integers(self, column: str, blank: int | None = None) -> np.ndarray:
        """Return (N,) whole numbers; an empty cell becomes `blank` where that is given."""
        values = self.numbers(
            column, "whole", blank is not None, lambda v: v.is_integer() and abs(v) < 2**53
        )
        return np.where(np.isnan(values), -1 if blank is None else blank, values).astype(np.int64)

    def is_numeric(self, column: str) -> bool:
        """Tell whether every filled cell of a column reads as a number."""
        try:
            for cell in filter(None, self.cells[column]):
                _read_number(cell)
        except ValueError:
            return False
        return True


def _read_number(text: str) -> float:
    """Return the number; ValueError if it is none, as ``1_5``, which Python would read as 15."""
    if "_" in text:
        raise ValueError(text)
    return float(text)


def read_table(path: str | Path) -> Table:
    """Read a comma-separated file in UTF-8 with a header and at most `MOST_CELLS` cells.

    Raises InputError if it is another kind of file, has no rows, or rows of different lengths.
    """
    where = str(path)
    check_regular(path)
    check_size(path)
    rows, count = [], 0
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            for row in reader:
                count += len(row) + 1
                check_cells(path, count)
                rows.append((reader.line_num, [cell.strip() for cell in row]))
    except OSError as error:
        raise InputError(where, "file", error.strerror or str(error), "a readable file") from error
    except UnicodeDecodeError as error:
        with open(path, "rb") as raw:
            kind = "a workbook" if raw.read(2) == b"PK" else "no UTF-8"
        allowed = f"comma-separated text in UTF-8; to convert it: longarm import-data {where}"
        raise InputError(where, "file", kind, f"{allowed} -o samples.csv") from error
    except csv.Error as error:
        raise InputError(where, "file", str(error), "comma-separated text in UTF-8") from error
    rows = [(line, row) for line, row in rows if any(row)]
    if not rows:
        raise InputError(where, "file", "empty", "a header and at least one row")
    header, body = rows[0][1], rows[1:]
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        allowed = f"columns separated by commas; to convert it: longarm import-data {where}"
        raise InputError(where, "header", header[0], f"{allowed} -o samples.csv --units mm,deg")
    if not body:
        raise InputError(where, "rows", 0, "at least one row below the header")
    for line, row in body:
        if len(row) != len(header):
            raise InputError(where, f"line {line}", f"{len(row)} cells", f"{len(header)} cells")
    cells = {name: [row[k] for _, row in body] for k, name in enumerate(header)}
    return Table(where, tuple(header), tuple(line for line, _ in body), cells)


WriteTable = Callable[[str | Path, Sequence[str], Iterable[Sequence[Any]]], None]
"""A function that writes a header, and rows in SI units, to a file."""


def write_table(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file, whole or not at all. Floats keep every digit; NaN and None are blank."""
    with atomic_path(path) as partial:
        fill_table(partial, header, rows)


def fill_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file as `write_table` does, but not atomically: an error leaves a part of it."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")  # None is blank; NaN, unequal to itself, too
        writer.writerow(header)
        writer.writerows([None if value != value else value for value in row] for row in rows)


# ------------------------------------------------------------------ names of columns


_FOREIGN = re.compile(r"(?i)(q|j|joint|axis|a|theta)[ _]?\d+|[xyz]|(p|pos|tip|tcp|meas)[ _.]?[xyz]")


def check_header(where: str, header: Sequence[str], required: Collection[str]) -> None:
    """Raise `InputError` if a column has no name, occurs twice, or is required and missing."""
    for place, name in enumerate(header, 1):
        if not name:
            raise InputError(where, f"header, column {place}", name, "a name")
        if header.index(name) != place - 1:
            raise InputError(where, f"column {name}", "twice", "each column once")
    for name in required:
        if name not in header:
            near = nearest(name, header)
            hint = f" (is it {near}?)" if near else ""
            allowed = " ".join(required)
            if "q1" in (*required, *header):  # a session, which it converts
                allowed += _suggest_conversion(where, header)
            raise InputError(where, f"column {name}", f"missing{hint}", allowed)


def _suggest_conversion(where: str, header: Sequence[str]) -> str:
    """Return a hint to `longarm import-data`, if the column names look like another program's."""
    split = [split_name(name) for name in header]
    suffixed = [unit for name, unit in split if unit is not None and _FOREIGN.fullmatch(name)]
    bare = [name for name, unit in split if unit is None and _FOREIGN.fullmatch(name)]
    others = [name for name in bare if not re.fullmatch(r"q\d+|[xyz]", name)]
    if not suffixed and not others:
        return ""
    units = " --units mm,deg" if bare else ""
    return f"; to convert it: longarm import-data {where} -o samples.csv{units}"


def check_unknown(where: str, names: Collection[str], known: Collection[str]) -> None:
    """Raise `InputError` for an unknown name that is close to a known one.

    A name is close if it differs in case, blanks and punctuation only; if its unit is missing or
    another (`temperature`, `x_mm`); or if one letter is wrong (two in names of eight or more).
    Columns with any other name are kept by the caller.
    """
    for name in names:
        meant = None if name in known else nearest(name, known)
        if meant is not None:
            value, allowed = f"unknown, close to {meant}", f"{meant}, or another name"
            if split_name(name)[1] is not None:
                allowed += f"; other units: longarm import-data {where} -o samples.csv"
            raise InputError(where, f"column {name}", value, allowed)


def nearest(name: str, known: Collection[str]) -> str | None:
    """Return the known name that `name` most likely means, or None."""
    plain = plain_name(name)
    stems = {plain, plain_name(split_name(name)[0])}
    for candidate in known:
        without = re.sub(r"_id$", "", split_name(candidate)[0])
        if stems & {plain_name(candidate), plain_name(without)}:
            return candidate
    wrong = 2 if len(plain) >= 8 else 1
    spelt = {plain_name(candidate): candidate for candidate in known}
    alike = [text for text in spelt if abs(len(text) - len(plain)) <= wrong and len(plain) >= 4]
    close = get_close_matches(plain, alike, 1, 1 - (wrong + 1e-9) / max(len(plain), 4))
    return spelt[close[0]] if close else None


def plain_name(name: str) -> str:
    """Return the letters and digits of a name, in lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())
