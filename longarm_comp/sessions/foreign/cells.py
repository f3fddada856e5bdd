"""The cells of a CSV or XLSX file as text, its header lines joined, its separators found."""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from longarm_comp.core.errors import InputError
from longarm_comp.sessions.foreign.units import unit_of

MOST_CELLS = 20_000_000
_SEPARATORS = ("\t", ";", ",", "|")
_POINT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_COMMA = re.compile(r"[-+]?(\d+,?\d*|,\d+)([eE][-+]?\d+)?")
_NONE = {"", "nan", "n/a", "na", "#n/a", "-", "--", "null", "none"}
_SAMPLE = 50


@dataclass(frozen=True)
class Cells:
    """A table of another program.

    Attributes:
        where: the file.
        names: columns; header lines are joined, a line of units is put behind the names.
        rows: (line in the file, cells) of each row.
        separator: between cells; empty for a sheet.
        decimal: the sign before decimals.
        header_lines: lines in the file that the names were made of.
    """

    where: str
    names: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    separator: str
    decimal: str
    header_lines: tuple[int, ...]

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
    """Read a table.

    Args:
        path: a CSV file with any separator, or an XLSX workbook.
        sheet: name of the sheet; by default the only one.
        decimal: ``.`` or ``,``; by default as the cells show it.

    Raises:
        InputError: unreadable, no row of numbers, rows of different length, several sheets.
    """
    where, separator = str(path), ""
    if path.suffix.lower() in (".xlsx", ".xlsm"):
        lines, sign = _sheet(path, sheet), "."
    else:
        text = _text(path)
        separator, lines = _separated(where, text)
        sign = _decimal(where, separator, lines)
    sign = decimal or sign
    first = _first_row(where, lines, sign)
    width = len(lines[first][1])
    names, used = _names(lines[:first], width)
    if not used:
        raise InputError(
            where, "header", "none", "a line with the columns' names above the numbers"
        )
    for line, row in lines[first:]:
        if len(row) != width:
            raise InputError(where, f"line {line}", f"{len(row)} cells", f"{width} cells")
    rows = tuple((line, tuple(row)) for line, row in lines[first:])
    return Cells(where, names, rows, separator, sign, used)


def _text(path: Path) -> str:
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
    """The separator under which most lines have one and the same number of cells above 1."""
    best: tuple[int, str, Lines] = (0, "", [])
    for mark in _SEPARATORS:
        try:
            reader = csv.reader(text.splitlines(keepends=True), delimiter=mark)
            lines = [(reader.line_num, [c.strip() for c in row]) for row in reader if any(row)]
        except csv.Error as error:
            raise InputError(where, "file", str(error), "separated text") from error
        if sum(len(row) for _, row in lines) > MOST_CELLS:
            raise InputError(where, "cells", f"more than {MOST_CELLS}", "a smaller file")
        widths = Counter(len(row) for _, row in lines)
        width, count = max(widths.items(), key=lambda item: (item[1] * (item[0] > 1), item[0]),
                           default=(0, 0))  # fmt: skip
        if width > 1 and count > best[0]:
            best = (count, mark, lines)
    if not best[0]:
        allowed = "a table with columns separated by comma, semicolon, tab or |"
        raise InputError(where, "file", "no columns", allowed)
    return best[1], [(line, row) for line, row in best[2] if any(row)]


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
    from openpyxl import load_workbook

    try:
        book = load_workbook(path, read_only=True, data_only=True)
    except Exception as error:  # whatever zipfile, XML and openpyxl raise on a damaged file
        said = f"{type(error).__name__}: {error}"
        raise InputError(path, "workbook", said, "an undamaged XLSX file") from error
    try:
        if name is None and len(book.sheetnames) > 1:
            raise InputError(path, "--sheet", "missing", f"one of {', '.join(book.sheetnames)}")
        chosen = name or book.sheetnames[0]
        if chosen not in book.sheetnames:
            raise InputError(path, "--sheet", chosen, f"one of {', '.join(book.sheetnames)}")
        lines: Lines = []
        held = 0
        for number, row in enumerate(book[chosen].iter_rows(values_only=True), 1):
            held += len(row)
            if held > MOST_CELLS:
                raise InputError(path, "cells", f"more than {MOST_CELLS}", "a smaller sheet")
            cells = ["" if v is None else str(v).strip() for v in row]
            if any(cells):
                lines.append((number, cells))
    except InputError:
        raise
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
        raise InputError(path, "sheet", said, "an undamaged XLSX file") from error
    finally:
        book.close()
    width = max((k for _, row in lines for k, c in enumerate(row, 1) if c), default=0)
    return [(line, [*row, *[""] * width][:width]) for line, row in lines]


def _first_row(where: str, lines: Lines, decimal: str) -> int:
    """Number of the first line of which most filled cells are numbers."""
    number = _COMMA if decimal == "," else _POINT
    widths = Counter(len(row) for _, row in lines)
    usual = widths.most_common(1)[0][0] if widths else 0
    for k, (_, row) in enumerate(lines):
        filled = [c for c in row if c.lower() not in _NONE]
        if len(row) == usual and len(filled) > 1:
            share = sum(number.fullmatch(c) is not None for c in filled) / len(filled)
            if share > 0.5:
                return k
    raise InputError(where, "rows", "no row of numbers", "numbers below a header")


def _names(lines: Lines, width: int) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the columns from the lines above the numbers, and the numbers of these lines."""
    whole = [(line, row) for line, row in lines if len(row) == width and sum(map(bool, row)) > 1]
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
