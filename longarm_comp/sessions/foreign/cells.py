"""The cells of a text table or XLSX sheet, its header lines joined, its separators found.

pandas reads; ours is only what is a header, a number, a column.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_size, check_unpacked
from longarm_comp.sessions.foreign.units import split_name, unit_of
from longarm_comp.sessions.table import check_cells

WORKBOOK = (".xlsx", ".xlsm")
_SEPARATORS = (r"\t", ";", ",", r"\|", r"\s{2,}|\t", r"\s+")
_POINT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_COMMA = re.compile(r"[-+]?(\d+,?\d*|,\d+)([eE][-+]?\d+)?")
_DATED = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{2,4}|\d:\d\d")
_NONE = {"", "nan", "n/a", "na", "#n/a", "-", "--", "null", "none"}


@dataclass(frozen=True)
class Cells:
    where: str
    names: tuple[str, ...]
    """Columns; header lines are joined, a line of units is put behind the names."""
    rows: tuple[tuple[int, tuple[str, ...]], ...]  # (line in the file, cells) of each row
    separator: str  # between cells; empty for a sheet
    decimal: str  # the sign before decimals
    header_lines: tuple[int, ...]  # lines in the file that the names were made of
    index: tuple[int, ...] = ()
    """Number of each row in the session, where the rows do not simply follow each other."""

    def column(self, place: int) -> list[str]:
        return [row[place] for _, row in self.rows]

    def place(self, key: str, field: str) -> int:
        """Place of the column that the user calls so: whole, without its unit, or without a title.

        Raises:
            InputError: about the option ``field``; there is none, or more than one.
        """
        stems = [split_name(name)[0] for name in self.names]
        for called in (
            lambda name, stem: name == key,
            lambda name, stem: stem == key,
            lambda name, stem: f" {name}".endswith(f" {key}") or f" {stem}".endswith(f" {key}"),
        ):
            pairs = enumerate(zip(self.names, stems, strict=True))
            found = [k for k, pair in pairs if called(*pair)]
            if found:
                break
        if len(found) != 1:
            raise InputError(self.where, field, key, f"one column of {', '.join(self.names)}")
        return found[0]

    def number(self, text: str) -> float | None:
        """The number in a cell; None where the cell holds no number. Raises nothing."""
        plain = text.strip()
        if (_COMMA if self.decimal == "," else _POINT).fullmatch(plain) is None:
            return None
        return float(plain.replace(",", "."))

    @staticmethod
    def empty(text: str) -> bool:
        """Whether a cell says that there is no value."""
        return text.strip().lower() in _NONE


Lines = list[tuple[int, list[str]]]


def read_cells(path: Path, sheet: str | None = None, decimal: str | None = None) -> Cells:
    """Read a table; by default of the only sheet, with the decimal sign that the cells show."""
    where, separator = str(path), ""
    if path.suffix.lower() in WORKBOOK:
        lines, sign, decimal = _sheet(path, sheet), ".", None  # its numbers are no text
    else:
        text = _text(path)
        separator, lines = _separated(where, text)
        sign = _decimal(where, separator, lines)
    sign = decimal or sign
    first = _first_row(where, lines, sign)
    width = len(lines[first][1])
    names, used = _names(lines[:first], width)
    if not used:
        allowed = "a line with the columns' names above the numbers"
        raise InputError(where, "header", "none", allowed)
    for line, row in lines[first:]:
        if len(row) != width:
            raise InputError(where, f"line {line}", f"{len(row)} cells", f"{width} cells")
    rows = tuple((line, tuple(row)) for line, row in lines[first:])
    return Cells(where, names, rows, separator, sign, used)


def _text(path: Path) -> str:
    check_size(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(path, "file", error.strerror or str(error), "a readable file") from error
    wide = raw[:2] in (b"\xff\xfe", b"\xfe\xff")
    for coding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return raw.decode(coding)
        except UnicodeDecodeError:
            continue
    raise InputError(
        path, "file", "bytes that are no text", "CSV in UTF-8, UTF-16 or CP1252, or XLSX"
    )


def _separated(where: str, text: str) -> tuple[str, Lines]:
    """The separator that makes the most lines of the file's beginning rows of numbers."""
    sample = "\n".join(text.splitlines()[:200])
    scores = {mark: _score(_grid(where, sample, mark)) for mark in _SEPARATORS}
    best = max(scores, key=scores.__getitem__)  # the first of equal ones
    if scores[best] == (0, 0):
        allowed = "a table with columns separated by comma, semicolon, tab, | or blanks"
        raise InputError(where, "file", "no columns", allowed)
    return best, _grid(where, text, best)


def _score(lines: Lines) -> tuple[int, int]:
    """How many lines have one and the same number of cells above 1, mostly numbers; and in all."""
    widths = Counter(len(row) for _, row in lines if len(row) > 1)
    alike = [[row for _, row in lines if len(row) == width] for width in widths]
    numeric = [
        sum(_numeric(row, _POINT) or _numeric(row, _COMMA) for row in rows) for rows in alike
    ]
    return max(zip(numeric, map(len, alike), strict=True), default=(0, 0))


def _grid(where: str, text: str, mark: str) -> Lines:
    """Number and cells of each line that is not blank."""
    import pandas as pd

    lines = text.splitlines()
    width = max((len(re.split(mark, line.strip())) for line in lines), default=0)
    check_cells(where, width * len(lines))
    if width < 2:
        return []
    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(line.strip(" ") for line in lines)), sep=mark, header=None,
            names=range(width), index_col=False, dtype=str, na_filter=False,
            skip_blank_lines=False, skipinitialspace=True, engine="python",
        )  # fmt: skip
    except (pd.errors.ParserError, pd.errors.EmptyDataError, csv.Error, ValueError) as error:
        raise InputError(where, "file", str(error), "separated text") from error
    rows = ([str(c).strip() for c in row if not pd.isna(c)] for row in frame.to_numpy().tolist())
    return [(line, row) for line, row in enumerate(rows, 1) if any(row)]


def _decimal(where: str, separator: str, lines: Lines) -> str:
    cells = [cell for _, row in lines for cell in row]
    commas = sum("," in c and _COMMA.fullmatch(c) is not None for c in cells)
    points = sum("." in c and _POINT.fullmatch(c) is not None for c in cells)
    if separator == "," and not commas:
        return "."
    if commas and points:
        allowed = "one sign before decimals; say it with --decimal , or ."
        raise InputError(where, "numbers", f"{commas} with a comma, {points} with a point", allowed)
    return "," if commas else "."


def _sheet(path: Path, name: str | None) -> Lines:
    """Lines of a sheet that have a filled cell, without what is empty beside and between them."""
    import openpyxl

    rows, count = [], 0
    try:
        with zipfile.ZipFile(path) as archive:
            check_unpacked(path, archive)
        with closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            sheets = [sheet.title for sheet in book.worksheets]
            if name is None and len(sheets) > 1:
                raise InputError(path, "--sheet", "missing", f"one of {', '.join(sheets)}")
            chosen = name or sheets[0]
            if chosen not in sheets:
                raise InputError(path, "--sheet", chosen, f"one of {', '.join(sheets)}")
            held = book[chosen]
            held.reset_dimensions()  # or every line is filled up to the farthest cell
            for line, row in enumerate(held.iter_rows(), 1):
                count += len(row) + 1
                check_cells(path, count)
                texts = [_shown(cell) for cell in row]
                if any(texts):
                    rows.append((line, texts))
    except InputError:
        raise
    except Exception as error:  # whatever zipfile, XML and pandas raise on a damaged file
        said = f"{type(error).__name__}: {error}"
        raise InputError(path, "workbook", said, "an undamaged XLSX file") from error
    width = max((k for _, row in rows for k, c in enumerate(row, 1) if c), default=0)
    check_cells(path, width * len(rows))
    return [(line, (row + [""] * width)[:width]) for line, row in rows]


def _shown(cell: Any) -> str:
    """Text of a sheet's cell; whole numbers without a point, errors of the sheet as nothing."""
    value = cell.value
    if value is None or cell.data_type == "e":
        return ""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return str(value).strip()


def _numeric(row: Sequence[str], number: re.Pattern[str]) -> bool:
    """Whether most filled cells of a row, and more than one, are numbers or times."""
    filled = [c for c in row if c.lower() not in _NONE]
    count = sum(bool(number.fullmatch(c) or _DATED.search(c)) for c in filled)
    return len(filled) > 1 and 2 * count > len(filled)


def _first_row(where: str, lines: Lines, decimal: str) -> int:
    """Number of the first line of which most filled cells are numbers."""
    number = _COMMA if decimal == "," else _POINT
    widths = Counter(len(row) for _, row in lines)
    usual = widths.most_common(1)[0][0] if widths else 0
    for k, (_, row) in enumerate(lines):
        if len(row) == usual and _numeric(row, number):
            return k
    raise InputError(where, "rows", "no row of numbers", "numbers below a header")


def _block(lines: Lines) -> Lines:
    """The lines of headings: those above a blank line, with a number or of one cell are a title."""
    made: Lines = []
    for line, row in reversed(lines):
        apart = made and made[-1][0] != line + 1
        titled = any(_POINT.fullmatch(c) or _DATED.search(c) for c in row if c)
        if made and (apart or titled or sum(map(bool, row)) < 2):
            break
        made.append((line, row))
    return made[::-1]


def _names(lines: Lines, width: int) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the columns from the lines above the numbers, and the numbers of these lines."""
    whole = [
        (line, row) for line, row in _block(lines) if len(row) == width and sum(map(bool, row)) > 1
    ]
    units = [all(unit_of(c) is not None for c in row if c) for _, row in whole]
    last = max((k for k, pure in enumerate(units) if not pure), default=-1)
    names = [""] * width
    for k, (_, row) in enumerate(whole):
        held = ""
        for j, cell in enumerate(row):
            if units[k]:
                names[j] += f" [{cell.strip('[](){}')}]" if cell else ""
                continue
            held = cell or (held if k < last else "")  # a heading over several columns
            names[j] = f"{names[j]} {held}".strip()
    return tuple(names), tuple(line for line, _ in whole)
